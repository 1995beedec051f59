"""Training through the plant: what is drawn, differentiated, kept and chosen."""

import json
import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

torch = pytest.importorskip("torch")

from agents import PolicyNetwork  # noqa: E402
from benchmarks.designs import SPANS  # noqa: E402
from benchmarks.lib.fan_out import FanOut  # noqa: E402
from benchmarks.rollout import make_plants, rollout  # noqa: E402
from benchmarks.train import command, through_plant  # noqa: E402
from benchmarks.train.__main__ import main  # noqa: E402
from benchmarks.train.through_plant import (  # noqa: E402
    TRAININGS,
    Draw,
    Network,
    Trainer,
    act,
    loss_of,
    run,
    training_key,
)

SMALL = replace(
    TRAININGS["nn-dpc"], steps=6, batch=4, samples=60, window=20, hidden=4, validate_every=2
)
MANY = replace(SMALL, plants="many")


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(through_plant, "VALIDATION_PLANTS", 4)
    monkeypatch.setattr(through_plant, "VALIDATION_SAMPLES", 40)


def train(training, folder, *, retrain=False):
    return command.run([training], folder, FanOut(1), retrain=retrain)[0]


def weights(network):
    return np.concatenate([W.ravel() for W, _ in network.layers])


class TestNetwork:
    @pytest.mark.parametrize("training", [SMALL, MANY])
    def test_in_numpy_it_is_what_it_was_in_torch(self, training):
        torch.manual_seed(0)
        network = Network(training)
        with torch.no_grad():
            network.layers[-1].weight.mul_(20.0)
        observations = torch.rand(50, 41) * 2.0 - 1.0
        observations[:, :21] *= 6.0
        expected = act(network.weights(), observations).detach().clamp(-1.0, 1.0).numpy()
        assert np.ptp(expected) > 1.0
        assert network.export().act(observations.numpy()) == pytest.approx(expected, abs=1e-6)

    def test_it_is_odd(self):
        network = Network(SMALL).export()
        observations = np.random.default_rng(0).uniform(-1, 1, size=(20, 41))
        assert network.act(-observations) == pytest.approx(-network.act(observations))

    def test_it_begins_close_to_what_holds_the_set_point(self):
        # 5 degC needs 5 * 0.07273 / -0.04964 = -7.3258 t/h.
        network = Network(SMALL).export()
        steady = np.concatenate([[5.0], np.full(20, 5.0), np.full(20, -0.73258)])
        network.act(steady)
        assert network.command == pytest.approx(-7.3258, abs=0.2)


class TestDraws:
    def test_same_seed_same_draws(self):
        first, again, other = (
            Draw(SMALL, 4, 60, *s).signals() for s in ((1, 2), (1, 2), (1, 3))
        )
        assert all(torch.equal(first[name], again[name]) for name in first)
        assert not any(torch.equal(first[name], other[name]) for name in first)

    def test_noise_is_that_of_the_plant(self):
        noise = Draw(SMALL, 2000, 40, 0).noise(torch.full((2000,), 0.5))
        assert noise.shape == (41, 2000)
        assert not noise[0].any()
        # One term, two, and all three: R times the squares of 1, 0.3574, 0.03392.
        for k, factor in ((1, 1.0), (2, 1.12773), (30, 1.12889)):
            assert noise[k].var().item() == pytest.approx(0.5 * factor, rel=0.1)
        products = (noise[30] * noise[31]).mean().item()
        assert products == pytest.approx(0.5 * (-0.3574 + 0.3574 * 0.03392), rel=0.15)

    def test_nominal_set_points_can_be_held(self):
        signals = Draw(SMALL, 500, 60, 0).signals()
        flows = signals["setpoint"].abs() * 0.07273 / 0.04964
        assert (flows > signals["dead_zone"]).all()
        assert (flows < 10.0).all()

    def test_some_nominal_plants_are_calm(self):
        noisy = Draw(SMALL, 1000, 10, 0).signals()["noise"].any(0)
        assert noisy.float().mean().item() == pytest.approx(SMALL.noisy, abs=0.05)

    def test_many_plants_stay_within_the_random_design(self):
        signals = Draw(MANY, 1000, 10, 0).signals()
        drifts = signals["gain_drift"] != 1.0
        assert drifts.float().mean().item() == pytest.approx(0.5, abs=0.05)
        for name in ("gain", "time_constant"):
            factor = signals[f"{name}_factor"]
            for values in (factor, factor * signals[f"{name}_drift"]):
                low, high = SPANS[f"{name}_factor"]
                assert low - 1e-5 < values.min() < low + 0.05
                assert high - 0.05 < values.max() < high + 1e-5
        assert set(signals["delay"].tolist()) == set(range(6, 37))


class TestGradient:
    def test_it_is_that_of_differences(self):
        training = replace(SMALL, samples=40, batch=3, noisy=0.0)
        torch.manual_seed(0)
        network = Network(training)
        plants = through_plant.make_plants(training, 3, 40)
        signals = Draw(training, 3, 40, 0).signals() | {"dead_zone": torch.zeros(3)}

        def loss():
            return loss_of(*run(plants, network, signals, 40), training)

        loss().backward()
        weight = network.layers[-1].weight
        analytic = weight.grad.clone()
        for i in range(4):
            at = []
            for step in (1e-2, -1e-2):
                with torch.no_grad():
                    weight[0, i] += step
                    at.append(loss().item())
                    weight[0, i] -= step
            numeric = (at[0] - at[1]) / 2e-2
            assert analytic[0, i].item() == pytest.approx(numeric, rel=0.05, abs=2e-3)

    @pytest.mark.parametrize("training", [SMALL, MANY])
    def test_training_reduces_the_error(self, training):
        trainer = Trainer(replace(training, steps=20, batch=16, samples=120, hidden=16))
        before = trainer.record()["validation_mae"]
        for _ in range(20):
            trainer.advance()
        assert trainer.record()["validation_mae"] < before

    def test_every_step_meets_other_plants(self, monkeypatch):
        met = []
        signals = Draw.signals
        monkeypatch.setattr(Draw, "signals", lambda draw: met.append(signals(draw)) or met[-1])
        trainer = Trainer(SMALL)
        for _ in range(2):
            trainer.advance()
        first, second = met
        assert not any(torch.equal(first[name], second[name]) for name in first)

    def test_a_price_on_moves_is_paid(self):
        errors, applied = torch.zeros(3, 1), torch.tensor([[0.0], [2.0], [-1.0]])
        assert loss_of(errors, applied, replace(SMALL, move_price=0.1)).item() == (
            pytest.approx(0.1 * (2.0 + 3.0) / 2)
        )

    def test_a_plant_in_numpy_answers_as_the_one_that_was_differentiated(self):
        torch.manual_seed(0)
        network = Network(SMALL)
        signals = {
            "dead_zone": torch.full((1,), 5.0),
            "noise": torch.zeros(101, 1),
            "setpoint": torch.full((101, 1), 5.0),
        }
        with torch.no_grad():
            plants = through_plant.make_plants(SMALL, 1, 100)
            errors, _ = run(plants, network, signals, 100)
        policy = network.export()
        plants = make_plants(1, 101, setpoint=5.0, **policy.observation)
        trajectory = rollout(plants, policy, 101, seed=0)
        error = trajectory.setpoint - trajectory.output
        assert error[1:] == pytest.approx(errors.numpy(), abs=1e-4)


class TestKept:
    def test_a_finished_network_is_loaded(self, tmp_path, monkeypatch):
        trained = train(SMALL, tmp_path)
        with monkeypatch.context() as patch:
            patch.setattr(Trainer, "advance", None)  # training again would raise
            loaded = train(SMALL, tmp_path)
        assert np.array_equal(weights(loaded), weights(trained))
        (file,) = tmp_path.glob("*/network.npz")
        stamp = file.stat().st_mtime_ns
        train(SMALL, tmp_path, retrain=True)
        assert file.stat().st_mtime_ns > stamp

    def test_seed_is_honoured(self, tmp_path):
        first, again, other = (
            weights(train(replace(SMALL, steps=2, seed=seed), tmp_path / name))
            for name, seed in (("first", 3), ("again", 3), ("other", 4))
        )
        assert np.array_equal(first, again)
        assert not np.array_equal(first, other)

    def test_a_damaged_file_is_named(self, tmp_path):
        file = tmp_path / training_key(SMALL) / "network.npz"
        file.parent.mkdir()
        file.write_bytes(b"half of it")
        with pytest.raises(ValueError, match="damaged") as error:
            train(SMALL, tmp_path)
        assert str(file) in str(error.value)
        train(SMALL, tmp_path, retrain=True)

    def test_the_best_in_validation_is_kept(self, tmp_path, monkeypatch):
        scores = iter([3.0, 1.0, 2.0])

        def validate(network, training):
            return {"validation_mae": next(scores), "validation_travel": 0.0}

        monkeypatch.setattr(through_plant, "validate", validate)
        kept = train(SMALL, tmp_path)
        trainer = Trainer(SMALL)
        for _ in range(4):
            trainer.advance()
        assert np.array_equal(weights(kept), weights(trainer.averaged.export()))
        assert kept.provenance["validation"]["step"] == 4

    def test_provenance_is_kept(self, tmp_path):
        kept = train(SMALL, tmp_path).provenance
        assert kept["training"]["seed"] == SMALL.seed
        assert kept["training"]["steps"] == 6
        assert kept["validation"]["seed"] >= 3_000_000
        assert {"torch", "numpy"} <= set(kept["versions"])
        assert kept["cpu_seconds"] > 0.0
        json.dumps(kept)

    def test_key_names_all_that_shapes_a_network(self):
        keys = {training_key(t) for t in (SMALL, MANY, replace(SMALL, seed=1))}
        assert len(keys) == 3
        assert training_key(SMALL) == training_key(replace(SMALL))


class TestCommand:
    @pytest.fixture(autouse=True)
    def short(self, monkeypatch):
        monkeypatch.setitem(TRAININGS, "nn-dpc", SMALL)

    def test_it_trains_and_validation_chooses(self, tmp_path, capsys):
        arguments = ["nn-dpc", "--networks", "2", "--out", str(tmp_path), "--jobs", "1"]
        assert main(arguments) == 0
        networks = [PolicyNetwork.load(path) for path in tmp_path.glob("*/network.npz")]
        assert len(networks) == 2
        best = min(networks, key=lambda network: network.provenance["validation"]["score"])
        chosen = PolicyNetwork.load(tmp_path / "nn-dpc.npz")
        assert chosen.provenance["training"] == best.provenance["training"]
        seed = best.provenance["training"]["seed"]
        assert f"chooses seed {seed}" in capsys.readouterr().out

    def test_prices_are_drawn(self, tmp_path):
        arguments = ["nn-dpc", "--networks", "1", "--prices", "0", "0.1", "--jobs", "1"]
        assert main([*arguments, "--steps", "2", "--out", str(tmp_path)]) == 0
        table = pd.read_csv(tmp_path / "nn-dpc-prices.csv")
        assert list(table["price"]) == [0.0, 0.1]
        assert (tmp_path / "nn-dpc-prices.png").stat().st_size > 1000

    def test_policies_of_ppo_are_listed_by_their_seeds(self, tmp_path, capsys):
        arguments = ["ppo", "--networks", "2", "--steps", "8", "--jobs", "1"]
        assert main([*arguments, "--out", str(tmp_path)]) == 0
        seeds = {"10000", "10001"}
        assert seeds <= set(capsys.readouterr().out.split())
        assert {file.stem for file in tmp_path.glob("*.npz")} == {f"ppo-{s}" for s in seeds}

    def test_a_price_given_twice_is_trained_once(self, tmp_path):
        arguments = ["nn-dpc", "--networks", "1", "--prices", "0.1", "0.1", "--jobs", "1"]
        assert main([*arguments, "--steps", "1", "--out", str(tmp_path)]) == 0
        assert len(pd.read_csv(tmp_path / "nn-dpc-prices.csv")) == 1

    @pytest.mark.parametrize("prices", [["-1"], ["nan"], ["cheap"], ["0.1", "--keep"]])
    def test_bad_prices_are_named(self, prices, capsys):
        with pytest.raises(SystemExit):
            main(["nn-dpc", "--prices", *prices])
        shown = capsys.readouterr().err
        assert re.search(
            "--prices: (must be a number of at least 0|goes without --keep)", shown
        )


@pytest.mark.parametrize("name", ["nn-dpc", "nn-adaptive"])
def test_the_networks_that_come_with_the_project(name):
    network = PolicyNetwork.pretrained(name)
    training = TRAININGS[name]
    assert network.observation == through_plant.windows(training.window)
    assert network.provenance["training"]["plants"] == training.plants
    assert network.provenance["validation"]["seed"] >= 3_000_000
