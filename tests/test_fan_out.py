"""Fan-out: nothing depends on where and when tasks run, and nothing that is done is lost."""

import os
import socket
import sys
from collections import Counter
from functools import partial

import pytest

from benchmarks.controllers.options import own_factory
from benchmarks.lib import fan_out, storage
from benchmarks.lib.command import UsageError
from benchmarks.lib.fan_out import FanOut, TasksFailedError
from benchmarks.lib.storage import Kept
from tests import tasks


def work(n, calls=None, seconds=0.0):
    return {f"plant {seed}": partial(tasks.draw, seed, calls, seconds) for seed in range(n)}


def run(given, folder=None, jobs=2):
    return FanOut(jobs=jobs).run(given, kept=folder and Kept(folder))


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
        for given, jobs in ((there, 1), (there, 2), (back, 2)):
            results = run(given, jobs=jobs)
            assert results == {f"plant {seed}": tasks.draw(seed) for seed in range(7)}
            assert list(results) == list(given)

    def test_with_one_job_tasks_run_here(self):
        assert run({"pid": os.getpid}, jobs=1) == {"pid": os.getpid()}
        assert run({"pid": os.getpid}) != {"pid": os.getpid()}
        one = partial(next, (os.getpid() for _ in "1"))  # which cannot be pickled
        assert run({"pid": one}) == {"pid": os.getpid()}

    @pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT to another process")
    def test_ctrl_c_is_heard_by_one_process(self):
        # The others would show tracebacks of their own, one of them perhaps while it starts.
        for jobs, heard in ((1, True), (2, False)):
            assert run({"a": tasks.hears_ctrl_c}, jobs=jobs) == {"a": heard}

    def test_a_result_that_json_cannot_hold_costs_no_other(self, tmp_path):
        with pytest.raises(
            TasksFailedError, match="a set: Its result cannot be kept"
        ) as raised:
            run({"a set": partial(set, "a"), **work(2)}, tmp_path, jobs=1)
        assert [*raised.value.errors] == ["a set"]
        assert run(work(2), tmp_path) == run(work(2))


class TestResume:
    def test_only_what_is_missing_runs(self, tmp_path, calls):
        first = run(work(4, calls), tmp_path / "out")
        again = run(work(6, calls), tmp_path / "out")
        assert counted(calls) == Counter(range(6))
        assert {name: again[name] for name in first} == first

    @pytest.mark.parametrize("damage", [lambda kept: kept[: len(kept) // 2], lambda _: b"\xff"])
    def test_a_damaged_result_is_made_again(self, tmp_path, damage):
        whole = run(work(3), tmp_path)
        file = sorted(tmp_path.iterdir())[1]
        kept = file.read_bytes()
        file.write_bytes(damage(kept))
        assert run(work(3), tmp_path) == whole
        assert file.read_bytes() == kept

    @pytest.mark.parametrize("jobs", [1, 2])
    def test_a_result_is_saved_before_the_run_has_ended(self, tmp_path, jobs):
        # So that a run that is killed goes on with what is missing.
        there = partial(tasks.until, partial(os.listdir, tmp_path), 10.0)
        assert run({**work(1), "the last": there}, tmp_path, jobs)["the last"]

    def test_other_arguments_versions_or_code_are_other_results(self, monkeypatch, tmp_path):
        keys = [storage.key(partial(tasks.draw, seed)) for seed in (1, 1, 2)]
        assert keys[0] == keys[1] != keys[2]
        for name, other in (("versions", {"numpy": "0.1"}), ("code", "edited")):
            with monkeypatch.context() as patch:
                patch.setattr(storage, name, lambda other=other: other)
                assert storage.key(partial(tasks.draw, 1)) != keys[0]
        assert storage.key(lambda: 1) is None  # it has no name by which to tell it from others
        assert run({"a lambda": lambda: 1}, tmp_path) == {"a lambda": 1}
        assert not list(tmp_path.iterdir())

    def test_edited_code_is_other_code(self, tmp_path, monkeypatch):
        (tmp_path / "agents").mkdir()
        monkeypatch.setattr(storage, "ROOT", tmp_path)
        monkeypatch.setattr(storage, "code", storage.code.__wrapped__)
        keys = []
        for text in ("1", "2", "2"):
            (tmp_path / "agents/pi.py").write_text(text)
            keys.append(storage.key(partial(tasks.draw, 1)))
        assert keys[0] != keys[1] == keys[2]

    def test_a_user_s_edited_controller_is_another_one(self, tmp_path, monkeypatch):
        monkeypatch.syspath_prepend(tmp_path)
        keys = []
        for text in ("PIController", "PIController  # tuned"):
            (tmp_path / "own_pi.py").write_text(
                f"from agents import {text}\n\n\nclass Own(PIController): ...\n"
            )
            keys.append(storage.key(partial(tasks.until, own_factory("own_pi:Own"))))
        assert keys[0] != keys[1]


class TestFailures:
    def test_a_killed_process_costs_the_tasks_under_way(self, tmp_path, calls):
        lossy = {**work(6, calls, 0.05), "the killer": partial(tasks.die_of_memory, 0)}
        lossy |= {f"later {seed}": partial(tasks.draw, seed, calls, 0.05) for seed in (7, 8, 9)}
        with pytest.raises(TasksFailedError, match="the same command tries again") as error:
            run(lossy, tmp_path / "out")
        # Of two processes, the other had one task in hand, and perhaps the next one.
        assert "the killer" in error.value.errors
        assert len(error.value.errors) <= 3
        assert len(list((tmp_path / "out").iterdir())) == 10 - len(error.value.errors)
        mended = {**lossy, "the killer": partial(tasks.draw, 10)}
        assert run(mended, tmp_path / "out")["later 9"] == tasks.draw(9)

    @pytest.mark.parametrize("jobs", [1, 2])
    def test_an_exception_names_its_task_and_spares_the_others(self, tmp_path, calls, jobs):
        faulty = {"the fault": partial(tasks.fail, 3), "left": partial(sys.exit, 3)}
        with pytest.raises(TasksFailedError, match="no such plant as 3") as error:
            run({**faulty, **work(4, calls)}, tmp_path / "out", jobs)
        assert set(error.value.errors) == {"the fault", "left"}
        assert "2 of 6 tasks failed" in str(error.value)
        assert "left: A controller called sys.exit(3)" in str(error.value)
        mended = {"the fault": partial(tasks.draw, 3), **work(4, calls)}
        assert run(mended, tmp_path / "out", jobs)["the fault"] == tasks.draw(3)
        assert counted(calls) == Counter(range(4))


def test_a_node_with_other_versions_computes_nothing():
    here = storage.versions()
    one = "one", partial(tasks.draw, 1)
    assert fan_out._attempt(*one, here) == ("one", tasks.draw(1), "")
    _, _, error = fan_out._attempt(*one, {**here, "numpy": "0.1", "more": "1.0"})
    assert f"it has {{'numpy': '{here['numpy']}'}}, and not" in error
    assert "'more': '1.0'" in error


def test_a_cluster_that_is_gone_is_not_waited_for(monkeypatch):
    pytest.importorskip("ray", reason="Ray is not installed")
    with socket.create_server(("127.0.0.1", 0)) as server:
        monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{server.getsockname()[1]}")
    with pytest.raises(UsageError, match="--backend: no Ray cluster can be reached: start one"):
        FanOut(backend="ray").run(work(1))
