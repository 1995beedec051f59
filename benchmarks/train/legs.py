"""Trainings in legs: each leg goes on from the checkpoint of the one before, on any machine.

What a leg returns, a checkpoint or the network, is written here, in the process that began the
trainings: those that run the legs write no file. A leg whose worker is lost is run again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from tqdm import tqdm

from agents import PolicyNetwork
from benchmarks.lib.fan_out import CellsFailedError, FanOut
from benchmarks.lib.storage import replacing
from benchmarks.train.checkpoint import Checkpoint


@dataclass(frozen=True)
class Course:
    """A training, and the files that keep it.

    Attributes
    ----------
    name
        In messages.
    leg
        Goes on from a checkpoint, or begins with None; returns another, or the network if it is
        finished. It can be pickled.
    steps
        How many there are.
    network
        The file of the finished network.
    checkpoint
        That of the training until then.
    """

    name: str
    leg: Callable[[Checkpoint | None], Checkpoint | PolicyNetwork]
    steps: int
    network: Path
    checkpoint: Path

    def go_on(self) -> Callable[[], Checkpoint | PolicyNetwork]:
        """Return the next leg."""
        if not self.checkpoint.exists():
            return partial(self.leg, None)
        return partial(self.leg, Checkpoint(self.checkpoint.read_bytes(), str(self.checkpoint)))

    def keep(self, found: Checkpoint | PolicyNetwork) -> int:
        """Write what a leg returned; return how many steps are taken."""
        if isinstance(found, Checkpoint):
            with replacing(self.checkpoint) as file:
                file.write_bytes(found.content)
            return found.steps
        with replacing(self.network) as file:
            found.save(file)
        self.checkpoint.unlink(missing_ok=True)
        return self.steps


def train(
    courses: Sequence[Course], fan_out: FanOut, *, retrain: bool = False, progress: bool = True
) -> None:
    """Finish or begin the trainings whose network is not there yet.

    Training that was interrupted and resumed ends in the same network, to the bit, as training
    that was not.

    Parameters
    ----------
    courses
        The trainings, which have different names.
    fan_out
        Runs a leg of each side by side, then the next.
    retrain
        Whether to forget what the files hold.
    progress
        Whether to show a progress bar.

    Raises
    ------
    CellsFailedError
        At the end, if some failed; one whose checkpoint is damaged names it.
    """
    if retrain:
        for course in courses:
            course.network.unlink(missing_ok=True)
            course.checkpoint.unlink(missing_ok=True)
    missing = {course.name: course for course in courses if not course.network.exists()}
    taken = dict.fromkeys(missing, 0)
    errors: dict[str, str] = {}
    total = sum(course.steps for course in missing.values())
    hidden = not (progress and missing)
    with tqdm(
        total=total, desc="training", unit=" steps", unit_scale=True, disable=hidden
    ) as bar:
        while missing:
            legs = {name: course.go_on() for name, course in missing.items()}
            try:
                for name, found in fan_out.stream(legs):
                    steps = missing[name].keep(found)
                    bar.update(steps - taken[name])
                    taken[name] = steps
                    if isinstance(found, PolicyNetwork):
                        del missing[name]
            except CellsFailedError as error:
                errors |= error.errors
                missing = {name: missing[name] for name in missing if name not in errors}
    if errors:
        raise CellsFailedError(errors, len(courses))
