"""Run what the pages print: `python -m tests.check_pages`, two minutes on two cores.

pytest does not collect this file. Commands run with few runs, trials and steps. The README's
training runs in full, and must have the score on the page. `.ci/clients` runs commands of other
libraries.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from agents import PolicyNetwork
from agents.networks import PRETRAINED
from mptc_gym import IDS, evaluate
from tests.conftest import ROOT
from tests.test_examples import bump_test
from tests.test_package import EXAMPLES, PAGES, TRAININGS, shortened

SHORT = {  # words that shorten a command, by its module or file
    "bounds": "--preset paper --mpc 2 --jobs 1",
    "claims": "--help",  # `tests/test_claims.py` runs it, which takes a minute
    "compare": "--runs 2 --jobs 1",
    "offline": "--episodes 2",
    "recurrent": "2 4",  # steps and plants of the training
    "sb3.py": "--steps 1000",
    "speed": "--rounds 1",
    "train": "--steps 1000 --networks 2 --jobs 1",
    "tune": "--trials 2",
}
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}


def write_files(folder: Path) -> None:
    """Write the files that the commands read into a folder."""
    for page in PAGES:
        named = r"`(\w+\.(?:json|py))`[^`]*:\n\n```\w+\n(.*?)```"
        for name, content in re.findall(named, page.read_text("utf-8"), re.DOTALL):
            folder.joinpath(name).write_text(content, encoding="utf-8")
    bump_test().to_csv(folder / "log.csv")
    for example, _ in EXAMPLES:
        if 'folder="best-hard"' in example:
            run(["-c", shortened(example)], folder)  # writes best-hard/best_model.zip


def commands() -> dict[Path, list[str]]:
    """Return the words after `python` of each command, by the first page that has it."""
    pages: dict[str, Path] = {}
    for page in PAGES:
        text = page.read_text("utf-8").replace("\\\n", "")
        for words in re.findall(r"python ((?:-m benchmarks\.|benchmarks/)[^`|#\n]+)", text):
            pages.setdefault(" ".join(words.split()), page)
    return {page: [words for words in pages if pages[words] == page] for page in PAGES}


def run(words: list[str], folder: Path) -> str:
    """Run Python with some words in a folder, and return what it prints."""
    begin = time.perf_counter()
    process = subprocess.run(
        [sys.executable, *words], cwd=folder, env=ENVIRONMENT, capture_output=True, text=True
    )
    seconds, command = time.perf_counter() - begin, " ".join(words).splitlines()[0]
    print(f"{seconds:4.0f} s  python {command[:80]}", flush=True)
    if process.returncode:
        raise SystemExit(process.stdout + process.stderr)
    return process.stdout


def run_commands(printed: list[str], folder: Path) -> None:
    """Run the commands of a page, shortened, in order: some read what earlier ones write."""
    for command in printed:
        words = shlex.split(command.replace("MODULE:FACTORY", "my_controllers:tuned_pi"))
        name = re.split(r"[./](?!py)", next(word for word in words if word != "-m"))[-1]
        if words[0] != "-m":
            words[0] = str(ROOT / words[0])
        run([*words, *SHORT.get(name, "").split()], folder)


def run_training(code: str, printed: str, folder: Path) -> None:
    """Train a policy; its rounding depends on the processor."""
    scores = [
        float(re.search(r"score (\S+);", text)[1])
        for text in (run(["-c", code], folder), printed)
    ]
    assert abs(scores[0] - scores[1]) < 0.05, scores


def check_networks() -> None:
    """Score the published networks of PPO as the page on training says."""
    page = (ROOT / "benchmarks/examples/train_your_own.md").read_text("utf-8")
    for name in ("ppo", "ppo-hard"):
        files = PRETRAINED.glob(f"{name}-[0-9]*.npz")
        networks = [PolicyNetwork.load(file) for file in files]
        cells = []
        for preset in ("paper", "noisy", "hard"):
            scores = [evaluate(n, IDS[preset], **n.interface).score for n in networks]
            cells.append(f"{min(scores):.3f} to {max(scores):.3f}")
        assert " | ".join(cells) in page, (name, cells)


def main() -> None:
    """Run two pages at a time, each in a folder of its own."""
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(2) as pool:
        ENVIRONMENT["MINARI_DATASETS_PATH"] = str(Path(scratch, "minari"))
        files = Path(scratch, "files")
        files.mkdir()
        write_files(files)
        folders = (shutil.copytree(files, Path(scratch, str(i))) for i in range(99))
        tasks = [
            pool.submit(run_training, code, printed, next(folders))
            for code, printed in TRAININGS
        ]
        tasks.append(pool.submit(check_networks))
        tasks += [
            pool.submit(run_commands, printed, next(folders))
            for printed in commands().values()
            if printed
        ]
        for task in tasks:
            task.result()


if __name__ == "__main__":
    main()
