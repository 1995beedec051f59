"""Training through the plant: what is drawn, differentiated, kept and chosen."""

import json
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from agents import LawNetwork, NeuralSmithPredictor  # noqa: E402
from agents.networks import PRETRAINED  # noqa: E402
from benchmarks.controllers.roster import ROSTER  # noqa: E402
from benchmarks.loop.rollout import make_plants, rollout  # noqa: E402
from benchmarks.train import __main__ as program  # noqa: E402
from benchmarks.train import loops, ppo, through_plant  # noqa: E402
from benchmarks.train.loops import Draw, Loops, environment  # noqa: E402
from benchmarks.train.through_plant import Net, Training, loss_of, train, validate  # noqa: E402
from mptc_gym import Parameters  # noqa: E402

SMALL = Training(steps=4, plants=4, samples=60, stretches=2, choosing=4, adding=3)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(through_plant, "VALIDATION_PLANTS", 4)
    monkeypatch.setattr(through_plant, "VALIDATION_SAMPLES", 40)


def lively(training, seed=0):
    """Return a network whose outputs matter."""
    torch.manual_seed(seed)
    net = Net(training)
    with torch.no_grad():
        for part in (net.choosing, net.adding):
            part[-1].weight.mul_(10.0)
    return net


class TestLaw:
    def test_what_is_trained_is_what_runs(self):
        # The same plant, set point and network, in PyTorch with its gradient and in NumPy.
        net, n, samples = lively(SMALL), 1, 150
        numbers = Draw(n, samples, SMALL.spread, 3).plants()
        for name in numbers:
            if name.endswith(("_variance", "_amplitude")):
                numbers[name] = torch.zeros(n)
            if name.endswith("_drift"):
                numbers[name] = torch.ones(n)
        numbers["setpoint"] = torch.where(torch.arange(samples + 1) < 70, 3.0, -4.0)[:, None]
        models = Draw(n, samples, SMALL.spread, 4).models(numbers, exact=True)
        models["first"] = torch.tensor([True])
        models["uncertainty"] = torch.tensor([0.1])
        with torch.no_grad():
            plants = environment(n, samples)
            errors, _ = Loops(plants, numbers, models, 0).run(net, samples)
        of = {name: values.item() for name, values in numbers.items() if values.ndim == 1}
        pole = 1.0 - loops.RATE / of["time_constant_factor"]
        alpha, scale, _ = loops.DYNAMICS.coefficients(
            of["gain_factor"], of["time_constant_factor"]
        )
        a, b = [1.0, *(-x for x in alpha)], [scale * x for x in Parameters().b]
        actuator = {name: of[name] for name in ("dead_zone", "u_min", "u_max")}
        controller = NeuralSmithPredictor(
            gain=sum(b) / sum(a), time_constant=-8.0 / np.log(pole), uncertainty=0.1,
            delay=8.0 * (of["delay"] + 1.0), network=net.export(), **actuator,
        )  # fmt: skip
        plant = {"a": a, "b": b, "setpoint": [3.0] * 70 + [-4.0], **actuator}
        plants = make_plants(1, samples + 1, **plant, delay=int(of["delay"]))
        trajectory = rollout(plants, controller, samples + 1, seed=0)
        error = (trajectory.setpoint - trajectory.output)[1:]
        reach = abs(controller.u_max - controller.u_min) / 2.0 * abs(sum(b) / sum(a))
        assert np.ptp(error) > 3.0
        np.testing.assert_allclose(error, errors.numpy() * reach, atol=0.02)

    def test_plants_can_be_made_and_their_set_points_held(self):
        draw = Draw(500, 60, SMALL.spread, 0)
        numbers = draw.plants()
        room = torch.minimum(-numbers["u_min"], numbers["u_max"])
        reach = room * numbers["gain_factor"] * loops.GAIN
        assert (numbers["setpoint"].abs().amax(0) <= reach).all()
        assert (numbers["dead_zone"] < room).all()
        assert 0.1 < (numbers["noise_variance"] == 0.0).float().mean() < 0.7
        wrong, exact = (draw.models(numbers, exact=told)["gain_factor"] for told in (0, 1))
        assert torch.equal(exact, numbers["gain_factor"])
        assert 0.4 < (wrong != exact).float().mean() < 0.7


class TestGradient:
    def test_it_is_that_of_differences(self):
        net, samples = lively(SMALL).double(), 60
        draw = Draw(3, samples, SMALL.spread, 0)
        numbers = {name: value.double() for name, value in draw.plants().items()}
        numbers |= {"dead_zone": torch.zeros(3, dtype=torch.double)}
        models = draw.models(numbers, exact=True)
        plants = environment(3, samples, dtype=torch.double)

        def loss():
            errors, applied = Loops(plants, numbers, models, 0).run(net, samples)
            return loss_of(errors, applied, numbers["small"], SMALL)

        torch.set_default_dtype(torch.double)
        try:
            loss().backward()
            weight = net.choosing[-1].weight
            analytic = weight.grad.clone()
            at = []
            for step in (1e-4, -1e-4):
                with torch.no_grad():
                    weight[-1, 0] += step
                    at.append(loss().item())
                    weight[-1, 0] -= step
        finally:
            torch.set_default_dtype(torch.float)
        assert analytic[-1, 0].item() == pytest.approx((at[0] - at[1]) / 2e-4, rel=0.05)

    def test_training_reduces_the_error(self):
        training = replace(SMALL, steps=8, plants=8, choosing=16, adding=8)
        torch.manual_seed(training.seed)
        before = validate(Net(training), training)
        after = train(training).provenance["validation"]
        assert after["all"] < before["all"]


class TestNetworks:
    def test_the_one_of_the_project_is_that_of_the_defaults(self):
        network = LawNetwork.load(PRETRAINED / "nn-smith.npz")
        kept = network.provenance
        assert kept["training"] == json.loads(json.dumps(through_plant.asdict(Training())))
        assert kept["cpu_seconds"] > 60.0
        count = sum(W.size + len(b) for W, b in (*network.choosing, *network.adding))
        of = Training()
        samples = of.steps * of.plants * of.samples / 1e6
        for name in ("nn-smith", "nn-self-tuning"):
            assert f"{count:,} weights" in ROSTER[name].searched
            assert f": {samples:.0f} M samples" in ROSTER[name].searched


@pytest.mark.parametrize(
    ("network", "steps", "files"),
    [("nn-smith", 1, {"nn-smith"}), ("ppo", 8, {"ppo-10000", "ppo-10001"})],
)
def test_the_command_lists_trainings_by_their_seeds(
    network, steps, files, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(through_plant, "TRAINING", SMALL)
    short = {"plants": ((64, {}),), "cases": {"short": {"max_episode_steps": 20}}}
    monkeypatch.setitem(ppo.RECIPES, "ppo", replace(ppo.RECIPES["ppo"], **short))
    arguments = [network, "--networks", "2", "--steps", str(steps), "--jobs", "1"]
    assert program.main([*arguments, "--out", str(tmp_path)]) == 0
    shown = capsys.readouterr().out
    assert {"10000", "10001"} <= set(shown.split())
    assert {file.stem for file in tmp_path.glob("*.npz")} == files
    if network == "nn-smith":
        best = LawNetwork.load(tmp_path / "nn-smith.npz").provenance["training"]["seed"]
        assert f"Validation chooses seed {best}" in shown
