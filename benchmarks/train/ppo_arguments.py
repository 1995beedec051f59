"""Everything that shapes a policy of PPO: its settings, and the plants it is trained on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from benchmarks.loop.designs import SPANS

DELAY, DEAD_ZONE = 18, 5.0  # of the paper's plant, samples and t/h


@dataclass(frozen=True)
class PPOArguments:
    """Everything that shapes a policy, except versions and code."""

    seed: int = 10_000
    """Of the initial policy, the exploration, and what the plants meet in training."""
    steps: int = 1_196_032
    """Samples of experience, all plants together."""
    starts: int = 4
    """How often to begin anew, with other initial weights and an equal share of the samples.
    Validation chooses the best of all: many a training ends with an offset, and more samples do
    not mend that."""
    max_move: float = 1.0
    """How far an action of 1 moves the flow, as a share of half its range."""
    undo_dead_zone: float = DEAD_ZONE
    """The dead zone that is undone on the way from the policy to the plant, t/h. A comparison
    takes that of the plant that is run."""
    noise_variance: float = 0.5
    """R of the plants trained on, degC^2. A policy trained with noise steers less nervously,
    and does better with another dead zone than one trained on that plant."""
    calm: float = 0.75
    """Share of the plants that have no noise. In noise, small offsets hardly cost anything."""
    plant: dict[str, Any] = field(default_factory=dict)
    """Arguments of the environment trained on, where it is not the nominal plant."""
    setpoint_amplitude: float = 6.0
    """Random set points are uniform within this, degC."""
    reward: str = "absolute"
    """The environment's; "absolute" is what the comparison measures."""
    error_scale: float = 50.0
    """The environment's, degC. It makes returns about 1 in size, which a value function learns
    much sooner than large ones."""
    error_window: int = 3
    """Errors in the observation."""
    action_window: int = DELAY + 3
    """Past actions in the observation, the differences of which are the past moves; with
    delay + 2 moves the noise-free problem is Markov."""
    n_envs: int = 64
    """Plants that are stepped at once."""
    n_steps: int = 64
    """Samples of each plant between two updates."""
    batch_size: int = 1024
    """Samples of a gradient step."""
    n_epochs: int = 5
    """How often an update goes through its samples."""
    learning_rate: float = 2e-3
    """At the start; it falls linearly, to a twentieth."""
    gamma: float = 0.95
    """Discount a sample."""
    gae_lambda: float = 1.0
    """Below 1, advantages lean on the value function, also for what the delay still hides."""
    clip_range: float = 0.2
    """How far an update may move the probability of an action."""
    log_std: tuple[float, float] = (-1.0, -3.0)
    """Logarithm of the standard deviation of the action, at first and at last. Left to itself
    it stays high, and a mean that is right with the exploration is wrong without it."""
    hidden: tuple[int, ...] = (64, 64)
    """Nodes of the hidden layers, of policy and value function alike."""

    @property
    def observation(self) -> dict[str, Any]:
        """Arguments of the environment that give the policy its observation."""
        return {"error_window": self.error_window, "action_window": self.action_window}

    @property
    def training(self) -> dict[str, Any]:
        """Arguments of the environment trained on."""
        return {
            **self.observation,
            **self.plant,
            "noise_variance": self.noise_variance,
            "reward": self.reward,
            "error_scale": self.error_scale,
            "setpoint": "random",
            "setpoint_amplitude": self.setpoint_amplitude,
        }

    @property
    def plants(self) -> list[tuple[int, dict[str, Any]]]:
        """How many plants to train on, and their arguments: the noisy ones, then the calm."""
        calm = round(self.calm * self.n_envs)
        groups = [
            (self.n_envs - calm, self.training),
            (calm, {**self.training, "noise_variance": 0.0}),
        ]
        return [(count, arguments) for count, arguments in groups if count]


# What makes a policy one for many plants, those of a random design.
RANDOMISED: dict[str, Any] = {
    "plant": {name: list(span) for name, span in SPANS.items() if name != "noise_variance"},
    "action_window": 39,
}
