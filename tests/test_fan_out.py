"""Fan-out: nothing depends on where and when tasks run, and nothing that is done is lost."""

import json
import os
import select
import subprocess
import sys
from collections import Counter
from functools import partial
from unittest.mock import Mock

import pytest

from benchmarks.lib import cluster, fan_out, storage
from benchmarks.lib.fan_out import FanOut, TasksFailedError
from tests import tasks
from tests.conftest import ROOT


def work(n, calls=None, seconds=0.0):
    return {f"plant {seed}": partial(tasks.draw, seed, calls, seconds) for seed in range(n)}


def run(given, folder=None, jobs=2):
    return FanOut(jobs).run(given, folder)


def counted(calls):
    """Return how often each seed was drawn."""
    return Counter(int(path.name.partition(" ")[0]) for path in calls.iterdir())


@pytest.fixture
def calls(tmp_path):
    folder = tmp_path / "calls"
    folder.mkdir()
    return folder


class TestNumbers:
    def test_jobs_and_order_do_not_matter(self):
        there = work(7)
        there["plant 0"] = partial(tasks.draw, 0, None, 0.3)  # the first is not ready first
        back = dict(reversed(there.items()))
        for given, jobs in ((there, 1), (there, 2), (back, 2), (back, 1)):
            results = run(given, jobs=jobs)
            assert results == {f"plant {seed}": tasks.draw(seed) for seed in range(7)}
            assert list(results) == list(given)

    def test_with_one_job_tasks_run_here(self):
        assert run({"pid": os.getpid}, jobs=1) == {"pid": os.getpid()}
        assert run({"pid": os.getpid}) != {"pid": os.getpid()}

    def test_what_is_read_is_what_was_returned(self, tmp_path):
        values = {"numbers": (1, 0.1, float("inf")), "text": "°C"}
        fresh = run({"a/b: c": partial(dict, values)}, tmp_path)
        assert fresh == run({"a/b: c": partial(dict, values)}, tmp_path)
        assert [path.name for path in tmp_path.iterdir()] == ["a%2Fb%3A c.json"]
        assert fresh["a/b: c"] == {"numbers": [1, 0.1, float("inf")], "text": "°C"}

    def test_a_result_that_json_cannot_hold_costs_no_other(self, tmp_path):
        with pytest.raises(TasksFailedError, match="a set: TypeError") as raised:
            run({"a set": partial(set, "a"), **work(2)}, tmp_path, jobs=1)
        assert [*raised.value.errors] == ["a set"]
        assert run(work(2), tmp_path) == run(work(2))


class TestResume:
    def test_only_what_is_missing_runs(self, tmp_path, calls):
        first = run(work(4, calls), tmp_path / "out")
        again = run(work(6, calls), tmp_path / "out")
        assert counted(calls) == Counter(range(6))
        assert {key: again[key] for key in first} == first

    @pytest.mark.parametrize(
        "damage",
        [
            lambda text: "[]",
            lambda text: "null",
            lambda text: '{"mae": null}',
            lambda text: json.dumps(json.loads(text)["value"]),  # without its checksum
            lambda text: text.replace('"seed": 1', '"seed": 3'),
            lambda text: text[: len(text) // 2],
            lambda text: "",
            lambda text: "\0" * len(text),
        ],
    )
    def test_a_damaged_result_is_made_again(self, tmp_path, calls, damage):
        whole = run(work(3), tmp_path / "out")
        file = tmp_path / "out" / "plant 1.json"
        text = file.read_text()
        damaged = damage(text)
        assert damaged != text
        file.write_text(damaged)
        assert run(work(3, calls), tmp_path / "out") == whole
        assert counted(calls) == Counter([1])
        assert file.read_text() == text

    @pytest.mark.parametrize("jobs", [1, 2])
    def test_a_result_is_saved_before_the_run_has_ended(self, tmp_path, jobs):
        # So that a run that is killed goes on with what is missing.
        there = partial(tasks.until, (tmp_path / "plant 0.json").exists, 10.0)
        assert run({**work(1), "the last": there}, tmp_path, jobs)["the last"]

    @pytest.mark.skipif(sys.platform == "win32", reason="Windows tells no child of its parent")
    def test_workers_end_when_their_parent_is_killed(self, tmp_path):
        # As long as a worker lives, one end of this pipe is open; here one waits, one works.
        pipe = tmp_path / "pipe"
        os.mkfifo(pipe)
        program = (
            "import sys; from functools import partial\n"
            "from benchmarks.lib.fan_out import FanOut; from tests import tasks\n"
            "work = {str(i): partial(tasks.hold, sys.argv[1], 60.0 * i) for i in range(2)}\n"
            "FanOut(2).run(work)"
        )
        command = [sys.executable, "-c", program, str(pipe)]
        with subprocess.Popen(command, cwd=ROOT) as process, pipe.open("rb", 0) as held:
            assert held.read(1) + held.read(1) == b"xx"
            process.kill()
            select.select([held], [], [], 15.0)
            os.set_blocking(held.fileno(), False)
            assert held.read(1) == b""  # None as long as there is a worker


class TestFailures:
    def test_a_lost_worker_costs_what_it_was_at(self, tmp_path, calls):
        lossy = work(20, calls, 0.05)
        lossy["plant 8"] = partial(tasks.die_once, 8, tmp_path / "died", calls)
        assert run(lossy, tmp_path / "out") == run(work(20))
        assert (tmp_path / "died").exists()
        times = counted(calls)
        assert set(times) == set(range(20))
        # At most two tasks were handed out for each of the two workers.
        assert sum(times.values()) - 20 <= 4

    def test_a_task_that_always_loses_its_worker_is_named(self, tmp_path):
        lossy = {**work(8), "the killer": partial(tasks.die, 0)}
        with pytest.raises(TasksFailedError, match="the killer") as error:
            run(lossy, tmp_path)
        assert list(error.value.errors) == ["the killer"]
        assert len(list(tmp_path.glob("plant *.json"))) == 8

    def test_a_fault_of_all_tasks_is_soon_given_up(self, monkeypatch):
        monkeypatch.setattr(fan_out, "GIVE_UP", 2)
        with pytest.raises(TasksFailedError, match="Not run") as error:
            run({f"plant {seed}": partial(tasks.die, seed) for seed in range(8)})
        assert len(error.value.errors) == 8

    @pytest.mark.parametrize("jobs", [1, 2])
    def test_an_exception_names_its_task_and_spares_the_others(self, tmp_path, calls, jobs):
        faulty = {"the fault": partial(tasks.fail, 3), **work(4, calls)}
        with pytest.raises(TasksFailedError, match="no such plant as 3") as error:
            run(faulty, tmp_path / "out", jobs)
        assert list(error.value.errors) == ["the fault"]
        assert "1 of 5 tasks failed" in str(error.value)
        mended = {**faulty, "the fault": partial(tasks.draw, 3)}
        assert run(mended, tmp_path / "out", jobs)["the fault"] == tasks.draw(3)
        assert counted(calls) == Counter(range(4))

    def test_a_stop_by_the_user_is_not_a_failure(self, tmp_path):
        stop = Mock(side_effect=KeyboardInterrupt)
        with pytest.raises(KeyboardInterrupt):
            run({**work(2), "stop": stop}, tmp_path, jobs=1)
        assert len(list(tmp_path.iterdir())) == 2


def test_a_node_with_other_versions_computes_nothing():
    here = storage.versions()
    assert cluster._answer(partial(tasks.draw, 1), here) == (tasks.draw(1), "", False)
    other = {**here, "numpy": "0.1", "more": "1.0"}
    result, error, lost = cluster._answer(partial(tasks.draw, 1), other)
    assert result is None
    assert lost
    assert f"it has {{'numpy': '{here['numpy']}'}}, and not" in error
    assert "'more': '1.0'" in error
