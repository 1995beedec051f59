"""Test the environment with one reinforcement-learning library, by its lines in clients.md.

Each line is taken from the page verbatim and used to train or to step. Options are added to the
commands to keep them short.
"""

import re
import subprocess
import sys
import zipfile
from importlib import metadata
from pathlib import Path

import gymnasium

import mptc_gym

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "benchmarks/examples/clients.md"


def lines(library: str) -> list[str]:
    """Return a library's lines from the page's table."""
    rows = [line.split(" | ") for line in PAGE.read_text(encoding="utf-8").splitlines()]
    found = [row[2] for row in rows if re.fullmatch(rf"\| {library}(,.*)?", row[0])]
    assert found, f"the page has no line of {library}"
    return [line.strip("`") for line in found]


def run(line: str, *options: str) -> subprocess.CompletedProcess:
    """Run a command from the page with the current Python."""
    program, *words = line.split()
    assert program == "python", line
    return subprocess.run([sys.executable, *words, *options], capture_output=True, text=True)


def torchrl() -> None:
    """Check GymEnv, and GymWrapper on the vector environment, with check_env_specs."""
    from torchrl.envs import GymEnv, GymWrapper
    from torchrl.envs.utils import check_env_specs

    names = {"GymEnv": GymEnv, "GymWrapper": GymWrapper, "gymnasium": gymnasium}
    env, batch = (eval(line, names) for line in lines("TorchRL"))
    check_env_specs(env)
    assert env.rollout(50)["next", "reward"].shape == (50, 1)
    check_env_specs(batch)
    assert batch.rollout(50)["next", "reward"].shape == (64, 50, 1)
    plants = gymnasium.make_vec(
        "MiddlePoint-v0", num_envs=4, max_episode_steps=20, autoreset_mode="Disabled"
    )
    rollout = GymWrapper(plants).rollout(60, break_when_any_done=False)
    assert rollout["next", "truncated"].sum(1).flatten().tolist() == [3] * 4


def skrl() -> None:
    """Train PPO briefly on the vector environment."""
    from skrl.agents.torch.ppo import PPO, PPO_CFG
    from skrl.envs.wrappers.torch import wrap_env
    from skrl.memories.torch import RandomMemory
    from skrl.trainers.torch import SequentialTrainer
    from skrl.utils.model_instantiators.torch import deterministic_model, gaussian_model

    (line,) = lines("skrl")
    env = eval(line, {"wrap_env": wrap_env, "gymnasium": gymnasium})
    spaces = {
        "observation_space": env.observation_space,
        "action_space": env.action_space,
        "device": "cpu",
    }
    layer = {"name": "net", "input": "OBSERVATIONS", "layers": [32], "activations": "elu"}
    policy = gaussian_model(**spaces, network=[layer], output="ACTIONS")
    value = deterministic_model(**spaces, network=[layer], output="ONE")
    settings = PPO_CFG()
    settings.rollouts = 16
    settings.experiment.write_interval = settings.experiment.checkpoint_interval = 0
    agent = PPO(
        models={"policy": policy, "value": value},
        memory=RandomMemory(memory_size=16, num_envs=env.num_envs, device="cpu"),
        cfg=settings,
        **spaces,
    )
    trainer = SequentialTrainer(env=env, agents=agent, cfg={"timesteps": 64, "headless": True})
    trainer.train()
    assert policy.log_std_parameter.item() != 0.0  # the initial value


def tianshou() -> None:
    """Train PPO on plants in Tianshou's own vector environment, for two episodes of each."""
    import torch
    from tianshou.algorithm import PPO
    from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
    from tianshou.algorithm.optim import AdamOptimizerFactory
    from tianshou.data import Collector, VectorReplayBuffer
    from tianshou.env import DummyVectorEnv
    from tianshou.trainer import OnPolicyTrainerParams
    from tianshou.utils.net.common import Net
    from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic

    (line,) = lines("Tianshou")
    plants = eval(line, {"DummyVectorEnv": DummyVectorEnv, "gymnasium": gymnasium})
    observation, action = plants.observation_space[0], plants.action_space[0]
    actor = ContinuousActorProbabilistic(
        preprocess_net=Net(state_shape=observation.shape, hidden_sizes=(32,)),
        action_shape=action.shape,
        unbounded=True,  # the policy clips
    )
    critic = ContinuousCritic(
        preprocess_net=Net(state_shape=observation.shape, hidden_sizes=(32,))
    )
    policy = ProbabilisticActorPolicy(
        actor=actor,
        dist_fn=lambda of: torch.distributions.Independent(torch.distributions.Normal(*of), 1),
        action_space=action,
        observation_space=observation,
    )
    algorithm = PPO(policy=policy, critic=critic, optim=AdamOptimizerFactory(lr=1e-3))
    before = actor.mu.model[0].weight.detach().clone()
    steps = 8 * 1200
    found = algorithm.run_training(
        OnPolicyTrainerParams(
            training_collector=Collector(algorithm, plants, VectorReplayBuffer(steps, 8)),
            max_epochs=2,
            epoch_num_steps=steps,
            collection_step_num_env_steps=steps,
            batch_size=256,
            show_progress=False,
            verbose=False,
        )
    )
    assert (found.train_step, found.train_episode) == (2 * steps, 16)
    assert not torch.equal(before, actor.mu.model[0].weight)


def rl_zoo3() -> None:
    """Train a policy and run it, by two commands."""
    train, enjoy = lines("RL Baselines3 Zoo")
    done = run(train, "-n", "2048")
    assert done.returncode == 0, done.stderr
    assert "total_timesteps | 2048" in done.stdout
    done = run(enjoy, "-n", "1200")
    assert done.returncode == 0, done.stderr
    assert "Mean episode length: 1200" in done.stdout


def rllib() -> None:
    """Train PPO briefly, and evaluate the policy by the words of the page."""
    import ray
    import torch
    from ray.rllib.algorithms.ppo import PPOConfig

    (line,) = lines("RLlib")
    page = PAGE.read_text(encoding="utf-8")
    (policy,) = re.findall(r"`(algorithm\.get_module.+?)`", page)
    # "local" ignores any cluster that runs here or that RAY_ADDRESS names.
    ray.init("local", num_cpus=1, include_dashboard=False, log_to_driver=False)
    config = eval(line, {"PPOConfig": PPOConfig}).env_runners(num_env_runners=0)
    algorithm = config.training(train_batch_size_per_learner=1000).build_algo()
    assert algorithm.train()["num_env_steps_sampled_lifetime"] == 1000

    names = {"algorithm": algorithm, "torch": torch}
    act = eval(f"lambda observations: {policy}[:, :1].detach().numpy()", names)
    assert mptc_gym.evaluate(act, episodes=2, action_window=20).mean_error < 100.0
    algorithm.stop()
    ray.shutdown()


def cleanrl() -> None:
    """Run CleanRL's file from its wheel, unchanged and with the one change on the page."""
    (line,) = lines("CleanRL")
    (wheel,) = Path().glob("cleanrl-*.whl")
    file = Path("ppo_continuous_action.py")
    text = zipfile.ZipFile(wheel).read(f"cleanrl/{file}").decode()
    options = ("--total-timesteps", "4096", "--cuda", "False")

    file.write_text(text, encoding="utf-8")
    done = run(line, *options)
    # If the file runs unchanged, the page no longer needs to mention the change.
    assert done.returncode, "the file runs unchanged"
    assert "TransformObservation.__init__() missing" in done.stderr, done.stderr

    page = " ".join(PAGE.read_text(encoding="utf-8").split())
    (change,) = re.findall(r"change `(.+?)` to `(.+?)`", page)
    assert text.count(change[0]) == 1
    file.write_text(text.replace(*change), encoding="utf-8")
    done = run(line, *options)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("SPS:") == 2  # rounds of 2,048 steps


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))  # for imports by the examples
    name = sys.argv[1]
    locals()[name]()
    packages = {"rllib": "ray", "cleanrl": "torch"}.get(name, name), "gymnasium", "torch"
    versions = ", ".join(f"{each} {metadata.version(each)}" for each in dict.fromkeys(packages))
    print(f"{name}: the environment works ({versions})")
