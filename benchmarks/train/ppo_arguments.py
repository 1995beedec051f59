"""Declare everything that shapes a PPO policy: its settings and its training plants."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

DELAY, DEAD_ZONE = 18, 5.0  # of the paper's plant, samples and t/h


@dataclass(frozen=True)
class PPOArguments:
    """Everything that shapes a policy, except versions and code."""

    seed: int = 10_000
    """Seed of the initial policy, the exploration, and the training episodes."""
    steps: int = 1_196_032
    """Samples of experience, summed over all plants."""
    starts: int = 4
    """Number of starts, each with new initial weights and an equal share of the samples.
    Validation chooses the best policy of all: many trainings end with an offset, and more
    samples do not remove it."""
    max_move: float = 1.0
    """Change of the flow at an action of 1, as a share of half its range."""
    compensate_dead_zone: float = DEAD_ZONE
    """Half width of the dead zone that is compensated between policy and plant, t/h. A
    comparison uses that of the plant it runs."""
    noise_variance: float = 0.5
    """R of the noisy training plants, degC^2. A policy trained with noise acts less nervously,
    and does better on a different dead zone than a policy trained with that one."""
    calm: float = 0.75
    """Share of the plants without noise. In noise, small offsets cost hardly anything."""
    plant: dict[str, Any] = field(default_factory=dict)
    """Arguments of the training environment that differ from the nominal plant's."""
    setpoint_amplitude: float = 6.0
    """Random set points are uniform between plus and minus this amplitude, degC."""
    reward: str = "absolute"
    """Reward of the environment; "absolute" is what the comparison measures."""
    error_scale: float = 50.0
    """Error scale of the environment, degC. It brings returns to a size of about 1, which a
    value function learns much sooner than large ones."""
    error_window: int = 3
    """Errors in the observation."""
    action_window: int = DELAY + 3
    """Past actions in the observation, whose differences are the past moves. With delay + 2
    moves, the noise-free problem is Markov."""
    n_envs: int = 64
    """Plants that are stepped in parallel."""
    n_steps: int = 64
    """Samples per plant between updates."""
    batch_size: int = 1024
    """Samples per gradient step."""
    n_epochs: int = 5
    """Passes over the samples per update."""
    learning_rate: float = 2e-3
    """Initial learning rate; it falls linearly to a twentieth."""
    gamma: float = 0.95
    """Discount factor per sample."""
    gae_lambda: float = 1.0
    """GAE's lambda; below 1, the value function also stands in for effects in transit."""
    clip_range: float = 0.2
    """How far an update may move the probability ratio of an action from 1."""
    log_std: tuple[float, float] = (-1.0, -3.0)
    """Logarithm of the action's standard deviation, at the start and at the end. If learnt, it
    stays high, and a mean that is right with the exploration is wrong without it."""
    hidden: tuple[int, ...] = (64, 64)
    """Nodes of the hidden layers, in both the policy and the value function."""

    @property
    def observation(self) -> dict[str, Any]:
        """Arguments of the environment that give the policy its observation."""
        return {"error_window": self.error_window, "action_window": self.action_window}

    @property
    def training(self) -> dict[str, Any]:
        """Arguments of the training environment."""
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
        """Numbers of training plants and their arguments: noisy plants, then calm ones."""
        calm = round(self.calm * self.n_envs)
        groups = [
            (self.n_envs - calm, self.training),
            (calm, {**self.training, "noise_variance": 0.0}),
        ]
        return [(count, arguments) for count, arguments in groups if count]
