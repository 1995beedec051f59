"""Behind the claims: settings of their own, verdicts and lives on made-up numbers."""

import dataclasses

import numpy as np
import pandas as pd
import pytest

from agents import DirectNNController
from benchmarks.claims import conditions, life, tables
from benchmarks.claims.__main__ import main
from benchmarks.claims.claims import CLAIMS, judge
from benchmarks.claims.conditions import converged_at, measure
from benchmarks.claims.settings import AS_REPORTED, LEVELS, RANGES, Batch, draw_settings, named
from benchmarks.loop.measures import settled
from benchmarks.loop.runs import make_plants, simulate
from tests.conftest import ROOT, assert_the_seed_is_all_that_differs, trajectory


@pytest.fixture
def short(monkeypatch):
    """Shorten all runs, so that their numbers mean little."""
    run = Batch.run
    monkeypatch.setattr(
        Batch, "run", lambda self, agent, samples, **a: run(self, agent, min(samples, 60), **a)
    )
    for module in (conditions, life):
        monkeypatch.setattr(module, "WINDOW", 12)
        monkeypatch.setattr(module, "DAY", 108)
    monkeypatch.setattr(conditions, "CONVERGENCE", 30)
    monkeypatch.setattr(conditions, "FAILURE", 30)
    monkeypatch.setattr(tables, "RESAMPLES", 2)
    monkeypatch.setattr(conditions, "reference", lambda samples, **arguments: 0.01)


class TestSettings:
    def test_numbers_are_drawn_from_their_ranges_evenly_on_a_log_scale(self):
        settings = draw_settings(4000, seed=1)
        for name, (low, high) in RANGES.items():
            values = np.log(settings[name] / low) / np.log(high / low)
            assert values.quantile([0.25, 0.5, 0.75]).to_numpy() == pytest.approx(
                [0.25, 0.5, 0.75], abs=0.03
            )
            assert values.between(0, 1).all()
        assert (settings["level"].value_counts(sort=False).index == LEVELS).all()
        assert_the_seed_is_all_that_differs(lambda seed: draw_settings(5, seed).to_numpy())

    def test_a_loop_of_a_batch_is_that_of_its_setting_and_seed(self):
        settings = pd.concat([named(), draw_settings(1, seed=3)[[*RANGES]]])
        batch = Batch(settings, 5.0, runs=2, seed=7)
        together = batch.by_setting(batch.run(batch.networks(), 200, setpoint=5.0).output)
        for i, (_, numbers) in enumerate(settings.iterrows()):
            for run in range(2):
                seed = 7 + 2 * i + run
                alone = DirectNNController(num_envs=1, seed=seed, **numbers)
                output = simulate(make_plants(1, 200, setpoint=5.0), alone, 200, seed).output
                np.testing.assert_allclose(together[:, i, run], output[:, 0], atol=1e-9)

    def test_rates_in_proportion_move_the_sums_of_larger_networks_as_much(self):
        batch = Batch(named()[1:], 5.0, runs=1, seed=0)
        for numbers, expected in (
            ({"nodes": 6}, (0.5, 0.5, 0.5, 1.0)),
            ({"length": 6}, (0.5, 1.0, 1.0, 1.0)),
            ({"nodes": 6, "in_proportion": False}, (1.0, 1.0, 1.0, 1.0)),
        ):
            networks = batch.networks(**numbers)
            rates = [getattr(networks, name).item() / AS_REPORTED[name] for name in life.RATES]
            assert rates == pytest.approx(expected)


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


class TestVerdicts:
    def test_a_claim_holds_where_all_its_criteria_are_met(self):
        ten = np.arange(10)
        quantities = {
            "settled, plain": np.array([ten < 9, ten < 9, ten < 8, ten < 9]).astype(float),
            "error, noise": np.array([[1.1], [1.2], [1.1], [np.nan]]),
            "error, plain": np.ones((4, 1)),
        }
        claims = {"noise": dataclasses.replace(CLAIMS["noise"], setpoints=("constant",))}
        judged = judge({"constant": quantities}, claims)
        # 9 of 10 runs are most runs; 1.2 is notable. Without one of its numbers, a claim cannot
        # be judged.
        assert judged["noise, constant"].tolist()[:3] == [1.0, 0.0, 0.0]
        assert np.isnan(judged["noise, constant"][3])
        assert judged["controls"].tolist() == [1.0, 1.0, 0.0, 1.0]

    def test_a_result_of_the_paper_holds_if_all_of_its_claims_do(self):
        works = {"dead-zone-works, square": [1.0, 1.0, np.nan]}
        costs = {"dead-zone-serious, square": [1.0, 0.0, np.nan]}
        holds = tables._results(pd.DataFrame(works | costs | {"pi, square": 1.0}), "square")
        assert holds["dead zone"].tolist()[:2] == [1.0, 0.0]
        assert holds.notna().sum(axis=1).tolist() == [2, 2, 1]

    def test_a_set_point_that_the_flow_cannot_hold_is_not_judged(self, short):
        for level, can_be_judged in ((4.75, False), (5.0, True)):
            batch = Batch(named(), level, runs=1, seed=0)
            measured = conditions.responses(batch, 60, {"setpoint": level})
            assert np.isfinite(measured["error, dead zone 7"]).all() == can_be_judged
            assert np.isfinite(measured["error, plain"]).all()
        for level, gain in ((4.25, "gain 1.25"), (5.5, "gain 0.8")):
            batch = Batch(named(), level, runs=1, seed=0)
            measured = conditions.changed_plants(batch, {"setpoint_amplitude": level})
            for plant in conditions.CHANGED_PLANTS:
                is_judged = np.isfinite(measured[f"error, {plant}, learning"]).all()
                assert is_judged == (plant != gain)

    def test_the_wrong_sign_diverges_and_the_right_one_settles(self):
        measured = conditions.responses(Batch(named(), 5.0, 3, 0), 600, {"setpoint": 5.0})
        for name, has in (("diverged, wrong sign", 1.0), ("diverged, plain", 0.0)):
            assert (measured[name] == has).all()
        assert (measured["settled, plain"] == 1.0).all()

    def test_short_runs_of_all_claims_give_the_numbers_that_they_gave(self, short):
        batch = Batch(named(), 5.25, runs=3, seed=500)
        judged = judge(measure(batch)).T.rename_axis("number").set_axis([*"ab"], axis=1)
        golden = pd.read_csv(ROOT / "tests/golden/claims.csv", index_col=0)
        pd.testing.assert_frame_equal(judged, golden, rtol=1e-7, atol=1e-7)


class TestLife:
    def test_times_of_a_made_up_life(self):
        errors = {"NN, rates x 1": [3.0, 1.05, 1.0, 2.0, 2.4], "PI (1992)": [2.5] * 5}
        operation = pd.DataFrame(
            {
                "plant": "plain",
                "controller": name,
                "days": k / 2,
                "error": e,
                "largest_weight": k,
            }
            for name, series in errors.items()
            for k, e in enumerate(series, start=1)
        )
        network, pi = life.summarise(operation).to_dict("records")
        # At 1.1 times the best, and at 0.95 times the error of PI (1992), 2.375.
        assert (network["learnt"], network["ruined"]) == (1.0, 2.5)
        assert (network["first"], network["best"], network["after a day"]) == (3.0, 1.0, 1.05)
        assert (network["last"], network["last weight"]) == (2.4, 5)
        assert np.isnan([pi["learnt"], pi["ruined"]]).all()

    def test_limits_of_the_variants(self):
        networks = life.LimitedNetworks(num_envs=2, weight_scale=5.0)
        first_rates = {name: np.ones(2) for name in life.RATES}
        limits = {"bound": np.array([2.0, np.inf]), "falls_from": np.array([np.inf, 2.0])}
        vars(networks).update(limits, first_rates=first_rates)
        for factor in (1.0, 1.0, 2 / 3, 0.5):
            networks.act(np.ones((2, 6)))
            assert networks.eta.tolist() == pytest.approx([1.0, factor])
        largest = np.abs(networks.weights.W).max(axis=(1, 2))
        assert largest[0] <= 2.0 < largest[1]


class TestCommand:
    WORDS = ("--jobs", "1", "--draws", "2", "--runs", "4", "--days", "1")

    def test_all_settings_and_pictures_are_written(self, short, tmp_path, capsys):
        out = tmp_path / "out"
        assert main([*self.WORDS, "--out", str(out)]) == 0
        assert "With -D(G), the training diverges at once" in capsys.readouterr().out
        draws = pd.read_csv(out / "claims.csv")
        assert len(draws) == 2
        assert set(draws["noise, constant"]) <= {0.0, 1.0}
        errors = pd.read_csv(out / "life.csv")
        assert errors.groupby(["plant", "controller"])["days"].max().eq(1.0).all()
        report = (out / "report.md").read_text("utf-8")
        for picture in ("life.png", "figures-constant.png", "figures-square.png"):
            assert f"({picture})" in report
            assert (out / picture).stat().st_size > 10_000

    def test_without_all_that_was_measured_there_is_no_verdict(
        self, short, tmp_path, monkeypatch, capsys
    ):
        monkeypatch.setattr(conditions, "measure", lambda batch, is_complete=True: 1 / 0)
        out = tmp_path / "out"
        assert main([*self.WORDS, "--out", str(out)]) == 1
        assert "ZeroDivisionError" in capsys.readouterr().err
        assert [path.name for path in out.iterdir()] == ["provenance.json"]
