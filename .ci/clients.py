"""Test the environment with one reinforcement-learning library, by its code in clients.md.

`python clients.py LIBRARY` calls the function LIBRARY. The function takes the code or commands
from the page verbatim, and trains or steps with them. Options are added to the commands to keep
them short.
"""

import re
import subprocess
import sys
import zipfile
from importlib import metadata
from pathlib import Path
from typing import Any

import gymnasium

import mptc_gym

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "benchmarks/examples/clients.md"


def code_of(library: str) -> list[str]:
    """Return the code or the command in each row of a library in the page's table."""
    page = PAGE.read_text(encoding="utf-8")
    # A row begins "| LIBRARY | VERSION | `CODE` |", or "| LIBRARY, VARIANT | ...".
    row = rf"^\| {library}(?:,[^|]*)? \| [^|]* \| `(.+?)`"
    code = re.findall(row, page, re.MULTILINE)
    assert code, f"the page has no row of {library}"
    return code


def run(command: str, *options: str) -> subprocess.CompletedProcess:
    """Run a command `python ...` from the page with the Python of this process.

    `options` are words that are added to the command.
    """
    program, *words = command.split()
    assert program == "python", command
    return subprocess.run([sys.executable, *words, *options], capture_output=True, text=True)


def torchrl() -> None:
    """Check `GymEnv`, and `GymWrapper` on the vector environment, with `check_env_specs`."""
    from torchrl.envs import GymEnv, GymWrapper
    from torchrl.envs.utils import check_env_specs

    names = {"GymEnv": GymEnv, "GymWrapper": GymWrapper, "gymnasium": gymnasium}
    env, batch = (eval(code, names) for code in code_of("TorchRL"))
    check_env_specs(env)
    assert env.rollout(50)["next", "reward"].shape == (50, 1)
    check_env_specs(batch)
    assert batch.rollout(50)["next", "reward"].shape == (64, 50, 1)
    plants = gymnasium.make_vec(
        "MiddlePoint-v0", num_envs=4, max_episode_steps=20, autoreset_mode="Disabled"
    )
    rollout = GymWrapper(plants).rollout(60, break_when_any_done=False)
    # Each of the 4 plants ends an episode of 20 steps three times.
    assert rollout["next", "truncated"].sum(1).flatten().tolist() == [3] * 4


def skrl() -> None:
    """Train PPO briefly on the vector environment."""
    from skrl.agents.torch.ppo import PPO, PPO_CFG
    from skrl.envs.wrappers.torch import wrap_env
    from skrl.memories.torch import RandomMemory
    from skrl.trainers.torch import SequentialTrainer
    from skrl.utils.model_instantiators.torch import deterministic_model, gaussian_model

    (code,) = code_of("skrl")
    env = eval(code, {"wrap_env": wrap_env, "gymnasium": gymnasium})
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

    (code,) = code_of("Tianshou")
    plants = eval(code, {"DummyVectorEnv": DummyVectorEnv, "gymnasium": gymnasium})
    observation_space = plants.observation_space[0]
    action_space = plants.action_space[0]
    actor = ContinuousActorProbabilistic(
        preprocess_net=Net(state_shape=observation_space.shape, hidden_sizes=(32,)),
        action_shape=action_space.shape,
        unbounded=True,  # the policy clips
    )
    critic = ContinuousCritic(
        preprocess_net=Net(state_shape=observation_space.shape, hidden_sizes=(32,))
    )

    def normal_distribution(parameters: tuple[torch.Tensor, torch.Tensor]) -> Any:
        """Return the distribution of actions from their means and standard deviations."""
        normal = torch.distributions.Normal(*parameters)
        return torch.distributions.Independent(normal, 1)

    policy = ProbabilisticActorPolicy(
        actor=actor,
        dist_fn=normal_distribution,
        action_space=action_space,
        observation_space=observation_space,
    )
    algorithm = PPO(policy=policy, critic=critic, optim=AdamOptimizerFactory(lr=1e-3))
    initial_weights = actor.mu.model[0].weight.detach().clone()
    steps = 8 * 1200  # an episode of each of the eight plants
    result = algorithm.run_training(
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
    assert result.train_step == 2 * steps
    assert result.train_episode == 16
    assert not torch.equal(initial_weights, actor.mu.model[0].weight)


def rl_zoo3() -> None:
    """Train a policy and run the policy, by two commands."""
    train, enjoy = code_of("RL Baselines3 Zoo")
    training = run(train, "-n", "2048")
    assert training.returncode == 0, training.stderr
    assert "total_timesteps | 2048" in training.stdout
    rollout = run(enjoy, "-n", "1200")
    assert rollout.returncode == 0, rollout.stderr
    assert "Mean episode length: 1200" in rollout.stdout


def rllib() -> None:
    """Train PPO briefly, and evaluate the policy by the code on the page."""
    import ray
    import torch
    from ray.rllib.algorithms.ppo import PPOConfig

    (code,) = code_of("RLlib")
    page = PAGE.read_text(encoding="utf-8")
    (policy,) = re.findall(r"`(algorithm\.get_module.+?)`", page)
    # "local" ignores any cluster that runs here or that RAY_ADDRESS names.
    ray.init("local", num_cpus=1, include_dashboard=False, log_to_driver=False)
    config = eval(code, {"PPOConfig": PPOConfig}).env_runners(num_env_runners=0)
    algorithm = config.training(train_batch_size_per_learner=1000).build_algo()
    assert algorithm.train()["num_env_steps_sampled_lifetime"] == 1000

    names = {"algorithm": algorithm, "torch": torch}
    # The policy returns means and then standard deviations of actions. The mean is the action.
    act = eval(f"lambda observations: {policy}[:, :1].detach().numpy()", names)
    assert mptc_gym.evaluate(act, episodes=2, action_window=20).mean_error < 100.0
    algorithm.stop()
    ray.shutdown()


def cleanrl() -> None:
    """Run CleanRL's file from its wheel, unchanged and with the one change on the page."""
    (command,) = code_of("CleanRL")
    (wheel,) = Path().glob("cleanrl-*.whl")
    file = Path("ppo_continuous_action.py")
    source = zipfile.ZipFile(wheel).read(f"cleanrl/{file}").decode()
    options = ("--total-timesteps", "4096", "--cuda", "False")

    file.write_text(source, encoding="utf-8")
    unchanged = run(command, *options)
    # If the file runs unchanged, the page no longer needs to mention the change.
    assert unchanged.returncode, "the file runs unchanged"
    assert "TransformObservation.__init__() missing" in unchanged.stderr, unchanged.stderr

    page = " ".join(PAGE.read_text(encoding="utf-8").split())
    ((old, new),) = re.findall(r"change `(.+?)` to `(.+?)`", page)
    assert source.count(old) == 1
    file.write_text(source.replace(old, new), encoding="utf-8")
    changed = run(command, *options)
    assert changed.returncode == 0, changed.stderr
    assert changed.stdout.count("SPS:") == 2  # rounds of 2,048 steps


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))  # for imports by the examples
    name = sys.argv[1]
    globals()[name]()
    # RLlib comes with the package ray, and the file of CleanRL is no installed package.
    package = {"rllib": "ray", "cleanrl": "torch"}.get(name, name)
    versions = [f"{used} {metadata.version(used)}" for used in (package, "gymnasium")]
    print(f"{name}: the environment works ({', '.join(versions)})")
