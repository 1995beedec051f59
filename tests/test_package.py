"""Check which packages import which, what an import loads, and the pages' examples."""

import ast
import re
import sys

import gymnasium
import pytest

from tests.conftest import ROOT, python

ALLOWED = {
    "mptc_gym": {"mptc_gym", "gymnasium", "numpy", "pygame"},  # pygame within functions
    "agents": {"agents", "mptc_gym", "numpy"},
}
FOLDERS = "mptc_gym", "agents", "benchmarks"


def modules_of(code):
    """Return the modules that some code imports, also within functions."""
    modules = set()
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:  # not of the same package
            modules.add(node.module or "")
    return modules


def packages(code):
    """Return the packages that some code imports, also within functions."""
    return {module.partition(".")[0] for module in modules_of(code)}


@pytest.mark.parametrize("package", ALLOWED)
def test_layers_import_downwards_only(package):
    for path in (ROOT / package).rglob("*.py"):
        allowed = ALLOWED[package] | sys.stdlib_module_names
        allowed |= {"torch"} if path.name == "torch_env.py" else set()
        if path.name in ("sb3.py", "sb3_vec_env.py"):
            allowed |= {"stable_baselines3", "torch"}
        assert packages(path.read_text("utf-8")) <= allowed, path


def test_controllers_import_the_plant_and_no_environment():
    for path in (ROOT / "agents").rglob("*.py"):
        for module in modules_of(path.read_text("utf-8")):
            assert not f"{module}.".startswith("mptc_gym.") or module.startswith(
                "mptc_gym.plant."
            ), path


def test_importing_controllers_loads_no_extra():
    process = python("-c", "import agents, sys; print(*sys.modules)")
    extras = {"matplotlib", "pandas", "pygame", "scipy", "torch"}
    assert not extras & {*process.stdout.split()}
    assert "agents.pi" in process.stdout.split()


PAGES = [ROOT / "README.md"]
PAGES += [page for name in FOLDERS for page in (ROOT / name).rglob("*.md")]
PAGES = [page for page in PAGES if "published" not in page.parts]
PAGES.remove(ROOT / "benchmarks/examples/clients.md")  # `.ci/clients` runs its code
BLOCKS = [
    block
    for page in PAGES
    for block in re.findall(
        r"```python\n(.*?)```(?:\n\n```text\n(.*?)```)?", page.read_text("utf-8"), re.DOTALL
    )
]
# `tests/check_pages.py` trains in full.
TRAININGS = [(code, printed) for code, printed in BLOCKS if printed and ".learn(" in code]
EXAMPLES = [block for block in BLOCKS if block not in TRAININGS]


COMPARE = {  # the packages of the extra "compare" that the benchmarks import
    "cyclopts", "joblib", "matplotlib", "pandas", "rich", "scipy", "tabulate",
}  # fmt: skip


def shortened(example):
    """Return the code of an example with few samples and plants."""
    return (
        re.sub(r"\d+_000", "1", example)
        .replace("samples=1200", "samples=100, episodes=5")
        .replace('-v0", 256', '-v0", 4')
        .replace("2048", "64")
    )


@pytest.mark.parametrize(("example", "printed"), EXAMPLES, ids=range(len(EXAMPLES)))
def test_examples_of_the_pages_run(example, printed, monkeypatch, tmp_path, capsys):
    names = packages(example)
    # `.ci/versions` tests without the extras, where many examples cannot run.
    if "benchmarks" in names:
        names |= COMPARE
    for name in names - {"agents", "benchmarks"}:
        pytest.importorskip(name, reason=f"the example needs {name}, of an extra")
    monkeypatch.chdir(tmp_path)
    if not printed:
        for spec in gymnasium.registry.values():
            if spec.id.startswith("MiddlePoint"):
                monkeypatch.setattr(spec, "max_episode_steps", 30)
    if "gymnasium.utils.play" in example:  # the window is closed at once
        pygame = pytest.importorskip("pygame")
        closed = pygame.event.Event(pygame.QUIT)
        monkeypatch.setattr(pygame.event, "get", lambda: [closed])
        # As it is imported, it asks for a window of Matplotlib, which it does not need.
        monkeypatch.setattr(gymnasium.logger, "warn", lambda *_: None)
    # An example whose output is not on the page runs for a short time only.
    exec(example if printed else shortened(example), {})
    if printed:
        assert capsys.readouterr().out == printed


def test_controllers_are_evaluated_without_any_extra():
    program = """
import sys
for name in ("torch", "stable_baselines3", "scipy", "pandas", "matplotlib", "pygame"):
    sys.modules[name] = None  # an import is an error from now on
import agents, mptc_gym
print(mptc_gym.evaluate(agents.PIController(), "MiddlePointNoisy-v0").mean_error)
import mptc_gym.torch_env
"""
    process = python("-OO", "-c", program)  # the option removes docstrings
    # The reference error is 1.6 degC, and the error of an idle valve 5 degC.
    assert 1.6 < float(process.stdout) < 5.0, process.stderr
    assert 'pip install "mptc_gym[torch]"' in process.stderr.splitlines()[-1]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_what_a_page_links_to_is_there(page):
    targets = re.findall(r"\]\(([^)]*)\)", page.read_text("utf-8"))
    for target in targets:
        # "ADDRESS" stands for the project's own address, in the text for Gymnasium's list.
        if target == "ADDRESS" or target.startswith("https://"):
            continue
        file, _, heading = target.partition("#")
        linked_page = page.parent / file if file else page
        assert linked_page.exists(), target
        if heading:
            text = re.sub(r"[^\w\n# -]", "", linked_page.read_text("utf-8"))
            text = text.lower().replace(" ", "-")
            assert re.search(f"^#+-{heading}$", text, re.MULTILINE), target
