"""Try one reinforcement-learning library on the environment, with the lines of clients.md."""

import sys

import gymnasium
import numpy as np

import mptc_gym  # noqa: F401 (registers the environment)


def torchrl() -> None:
    """GymEnv, and GymWrapper on the vector environment; check_env_specs on both."""
    from torchrl.envs import GymEnv, GymWrapper
    from torchrl.envs.utils import check_env_specs

    env = GymEnv("MiddlePoint-v0", setpoint="random", action_window=20)
    check_env_specs(env)
    assert env.rollout(50)["next", "reward"].shape == (50, 1)
    for mode in ("Disabled", "SameStep"):
        plants = gymnasium.make_vec(
            "MiddlePoint-v0", num_envs=4, max_episode_steps=20, autoreset_mode=mode
        )
        batch = GymWrapper(plants)
        check_env_specs(batch)
        rollout = batch.rollout(60, break_when_any_done=False)
        assert rollout["next", "truncated"].sum(1).flatten().tolist() == [3] * 4, mode


def skrl() -> None:
    """PPO on the vector environment, for a moment."""
    import torch
    from skrl.agents.torch.ppo import PPO, PPO_CFG
    from skrl.envs.wrappers.torch import wrap_env
    from skrl.memories.torch import RandomMemory
    from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
    from skrl.trainers.torch import SequentialTrainer

    class Policy(GaussianMixin, Model):
        def __init__(self, **spaces: object) -> None:
            Model.__init__(self, **spaces)
            GaussianMixin.__init__(self)
            self.mean = torch.nn.Linear(self.num_observations, 1)
            self.log_std = torch.nn.Parameter(torch.zeros(1))

        def compute(self, inputs: dict, role: str) -> tuple:
            return self.mean(inputs["observations"]), {"log_std": self.log_std}

    class Value(DeterministicMixin, Model):
        def __init__(self, **spaces: object) -> None:
            Model.__init__(self, **spaces)
            DeterministicMixin.__init__(self)
            self.value = torch.nn.Linear(self.num_observations, 1)

        def compute(self, inputs: dict, role: str) -> tuple:
            return self.value(inputs["observations"]), {}

    env = wrap_env(gymnasium.make_vec("MiddlePoint-v0", num_envs=8, action_window=20))
    spaces = {
        "observation_space": env.observation_space,
        "action_space": env.action_space,
        "device": "cpu",
    }
    settings = PPO_CFG()
    settings.rollouts = 16
    settings.experiment.write_interval = settings.experiment.checkpoint_interval = 0
    policy = Policy(**spaces)
    before = policy.mean.weight.clone()
    agent = PPO(
        models={"policy": policy, "value": Value(**spaces)},
        memory=RandomMemory(memory_size=16, num_envs=8, device="cpu"),
        cfg=settings,
        **spaces,
    )
    trainer = SequentialTrainer(env=env, agents=agent, cfg={"timesteps": 64, "headless": True})
    trainer.train()
    assert not torch.equal(before, policy.mean.weight)


def cleanrl() -> None:
    """Wrap as CleanRL's PPO for continuous actions does, in its order."""

    def thunk() -> gymnasium.Env:
        env = gymnasium.make("mptc_gym:MiddlePoint-v0")
        wrappers = gymnasium.wrappers
        env = wrappers.RecordEpisodeStatistics(wrappers.FlattenObservation(env))
        env = wrappers.NormalizeObservation(wrappers.ClipAction(env))
        env = wrappers.TransformObservation(
            env, lambda observation: np.clip(observation, -10, 10), env.observation_space
        )
        env = wrappers.NormalizeReward(env, gamma=0.99)
        return wrappers.TransformReward(env, lambda reward: np.clip(reward, -10, 10))

    envs = gymnasium.vector.SyncVectorEnv(
        [thunk] * 2, autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP
    )
    envs.reset(seed=1)
    rng = np.random.default_rng(0)
    for k in range(1, 1201):
        _, _, _, truncations, infos = envs.step(rng.normal(size=(2, 1)).astype(np.float32))
        assert truncations.all() == (k == 1200)
    assert infos["final_info"]["episode"]["l"].tolist() == [1200, 1200]


def tianshou() -> None:
    """Step Tianshou's own batch of plants, which has no autoreset, to the end of an episode."""
    from tianshou.env import DummyVectorEnv

    plants = DummyVectorEnv(
        [lambda: gymnasium.make("MiddlePoint-v0", action_window=20) for _ in range(4)]
    )
    observations, _ = plants.reset(seed=0)
    assert observations.shape == (4, 26)
    for k in range(1, 1201):
        observations, rewards, _, truncations, _ = plants.step(np.zeros((4, 1), np.float32))
        assert np.isfinite(rewards).all()
        assert truncations.all() == (k == 1200)


if __name__ == "__main__":
    locals()[sys.argv[1]]()
    print(f"{sys.argv[1]}: the environment works")
