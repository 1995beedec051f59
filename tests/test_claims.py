"""Behind the claims: verdicts on made-up numbers, detectors on known sequences."""

import math
from unittest.mock import Mock

import numpy as np
import pandas as pd

from benchmarks.claims import examinations
from benchmarks.claims.__main__ import main
from benchmarks.claims.claims import CLAIMS, Claim, examined
from benchmarks.claims.findings import judge, sections, table, verdict
from benchmarks.claims.runs import Batch, converged_at
from benchmarks.lib.statistics import Estimate
from benchmarks.loop.measures import settled
from tests.conftest import ROOT, trajectory

GOOD, INFORMATION = {"at_least": 1.0}, {}


def asked(*bounds):
    """Return what is found if a number from 1 to 2 is to keep these bounds."""
    return [judge("a number", Estimate(1.5, 1.0, 2.0, 1000), **limits) for limits in bounds]


class TestVerdicts:
    def test_the_whole_interval_must_keep_the_criterion(self):
        both = {"at_least": 0.5, "at_most": 1.9}
        for bounds, criterion, answer, verdict_in_words in [
            ({"at_least": 0.5}, "at least 0.5", "yes", "holds"),
            ({"at_most": 1.5}, "at most 1.5", "undecided", "undecided"),
            ({"at_least": 2.5}, "at least 2.5", "no", "does not hold"),
            ({"at_most": 0.5}, "at most 0.5", "no", "does not hold"),
            (both, "at least 0.5 and at most 1.9", "undecided", "undecided"),
            (INFORMATION, "", "", "cannot be tested from the text"),
        ]:
            (finding,) = asked(bounds)
            assert (finding["criterion"], finding["shown"]) == (criterion, answer)
            # Information beside it changes nothing, something that is shown does.
            assert verdict([finding]) == verdict(asked(bounds, INFORMATION)) == verdict_in_words
            with_good = "holds" if answer in ("yes", "") else "holds in part"
            assert verdict(asked(bounds, GOOD)) == with_good
        assert verdict(asked({"at_most": 1.5}, {"at_most": 0.5})) == "does not hold"

    def test_the_report_by_hand(self, monkeypatch):
        for name, statement in (("good", "It is good"), ("none", "It cannot be")):
            claim = Claim("Section 1", statement, "By looking.", Mock())
            monkeypatch.setitem(CLAIMS, name, claim)
        good = asked(GOOD)
        for low, value, high in ((0.12345, 12.345, 1234.5), (-math.inf, 0.0, math.inf)):
            good.append(judge("a number", Estimate(value, low, high, 1000)))
        good.append(judge("another", 0.5, "t/h"))
        good.append(judge("the last", 0.5, at_most=0.4))
        numbers = table(CLAIMS, {"good": good, "none": []})
        overview, of_good, of_none = sections(CLAIMS, numbers)
        assert overview.table.to_numpy().tolist() == [
            ["It is good", "holds in part"], ["It cannot be", "cannot be tested from the text"],
        ]  # fmt: skip
        assert of_good.title == "It is good: holds in part"
        assert of_good.text == ["Section 1. By looking."]
        assert of_good.table.to_numpy().tolist() == [
            ["a number", "1.500", "1.000 to 2.000", "at least 1", "yes"],
            ["a number", "12.3", "0.123 to 1,234", "", ""],
            ["a number", "0.000", "? to never", "", ""],
            ["another (t/h)", "0.500", "exact", "", ""],
            ["the last", "0.500", "exact", "at most 0.4", "no"],
        ]
        assert of_none.table is None
        assert list(numbers["claim"]) == ["good"] * 5 + ["none"]


def test_known_sequences_converge_where_they_should():
    k = np.arange(400)
    distances = [
        np.where(k < 70, 1.0, 0.0),  # a jump
        0.9**k,  # 0.9^28 = 0.052, 0.9^29 = 0.047
        np.where(k == 200, 0.06, 0.0) + (k == 0),  # leaves the band once more
        np.zeros(400),  # nothing to learn
    ]
    paths = np.array(distances).T[:, :, np.newaxis]  # of one weight of each run
    assert list(converged_at(paths)) == [70, 29, 201, 0]


def test_settled_are_the_last_50_samples():
    for early, output, has in (50, 5.2, True), (50, 5.3, False), (51, 5.0, False):
        outputs = np.array([0.0] * early + [output] * (100 - early))
        for sign in (1.0, -1.0):
            assert settled(trajectory([sign * 5.0] * 100, sign * outputs)) == [has]


class TestCommand:
    def test_what_has_finished_is_written(self, tmp_path, monkeypatch, capsys):
        fails = Claim("", "", "", Mock(side_effect=ArithmeticError("no weights")))
        monkeypatch.setitem(CLAIMS, "noise", fails)
        out = tmp_path / "out"
        words = ["--jobs", "1", "--runs", "4", "--out", str(out), "noise", "direction"]
        assert main(words) == 1
        numbers = pd.read_csv(out / "claims.csv")
        assert set(numbers["claim"]) == {"direction"}
        assert numbers["value"].iloc[1] == 100.0  # all of them diverge in the end ...
        assert numbers["shown"].iloc[1] == "undecided"  # ... but four prove little
        assert "Unfinished: 1 of 2 tasks are missing." in (out / "report.md").read_text()
        assert "Training with -D(G) diverges at once" in capsys.readouterr().out

    def test_short_runs_of_all_claims_give_the_numbers_that_they_gave(self, monkeypatch):
        class Short(Batch):
            def run(self, agent, samples, **arguments):
                return super().run(agent, min(samples, 60), **arguments)

        monkeypatch.setattr(examinations, "LEARNING_LENGTH", 30)
        rows = [
            {
                "claim": name,
                **{column: row[column] for column in ("value", "low", "high", "criterion")},
            }
            for name in CLAIMS
            for row in examined(name, Short(3, 500))
        ]
        golden = pd.read_csv(ROOT / "tests/golden/claims.csv", keep_default_na=False)
        pd.testing.assert_frame_equal(pd.DataFrame(rows), golden, rtol=1e-8, atol=1e-8)
