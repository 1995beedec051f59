"""Check that an installed mptc_gym is complete, brings nothing else and runs."""

import re
import sys
import warnings
from importlib.metadata import distribution
from importlib.util import find_spec
from pathlib import Path

import gymnasium
from gymnasium.utils.env_checker import check_env

# Packages of the checkout and the extras, none of which may come with mptc_gym.
ABSENT = (
    "agents", "benchmarks", "tests", "torch", "stable_baselines3", "matplotlib", "scipy",
    "pandas", "pygame",
)  # fmt: skip
warnings.simplefilter("error")

installed = distribution("mptc_gym")
files = {file.as_posix() for file in installed.files or ()}
info = f"mptc_gym-{installed.version}.dist-info"
assert {file.partition("/")[0] for file in files} == {"mptc_gym", info}, sorted(files)
shipped = {f"mptc_gym/{name}" for name in ("py.typed", "CHANGELOG.md", "bounds.json")}
shipped.add(f"{info}/licenses/LICENSE")
assert shipped <= files, sorted(files)
brought_along = [name for name in ABSENT if find_spec(name)]
assert not brought_along, brought_along

about = installed.metadata
# The package has no pictures or pages; its README links to those at the repository, if known.
pictures = re.findall(r"!\[[^]]*\]\(([^)]*)\)", str(about.get_payload()))
assert pictures
if about.get_all("Project-URL"):
    assert all("/raw/HEAD/" in picture for picture in pictures), pictures
needed = [package for package in installed.requires or () if "extra ==" not in package]
assert sorted(package.partition(">=")[0] for package in needed) == ["gymnasium", "numpy"]

env = gymnasium.make("mptc_gym:MiddlePoint-v0", noise_variance=0.5)
check_env(env.unwrapped, skip_render_check=True)  # rendering needs an extra
envs = gymnasium.make_vec("MiddlePoint-v0", num_envs=8, noise_variance=0.5)
envs.reset(seed=0)
envs.step(envs.action_space.sample())

from mptc_gym.agents import DirectNNController, PIController  # noqa: E402

import mptc_gym  # noqa: E402 (last, since the id above must do without it)

assert Path(mptc_gym.__file__).is_relative_to(sys.prefix), mptc_gym.__file__
assert mptc_gym.__version__ == installed.version
changelog = Path(mptc_gym.__file__).with_name("CHANGELOG.md").read_text(encoding="utf-8")
assert f"## {installed.version} (" in changelog  # with a date
idle = mptc_gym.evaluate(lambda observations: 0.0 * observations[:, :1], "MiddlePointHard-v0")
assert abs(idle.score) < 1e-9 < idle.reference < idle.mean_error, idle
for controller in DirectNNController(num_envs=5), PIController():
    scored = mptc_gym.evaluate(controller, episodes=5)
    assert scored.score > 0.5, scored
print(f"mptc_gym {installed.version} is complete and runs, with nothing but {needed}")
