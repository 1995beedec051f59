"""The roster: what holds for any controller, as every command runs it; and a user's own."""

import numpy as np
import pytest

from benchmarks.controllers import pretrained
from benchmarks.controllers.options import chosen
from benchmarks.controllers.own import own_factory
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command_line import UsageError
from benchmarks.limits.verify import errors
from benchmarks.metrics import mean_error
from benchmarks.scenarios import Scenario
from benchmarks.sweep.cells import agent_cell
from benchmarks.train.ppo import PolicyRequest
from benchmarks.watch import rivals

ACTUATOR = {"u_min": -9.0, "u_max": 14.0, "dead_zone": 4.0}
# A plant of the other direction, which shows an input sooner.
OTHER = {**ACTUATOR, "b": [0.0456, 0.00404], "delay": 9}
IDLE = 5.0  # mean |e| of a valve that is left alone, degC


@pytest.fixture(params=ROSTER)
def entry(request):
    return ROSTER[request.param]


@pytest.fixture
def factory(entry, tmp_path, monkeypatch):
    # PPO for many plants does not come with the project: here it is that for the paper's.
    monkeypatch.setattr(pretrained, "RANDOMISED", {})
    return entry.members(PolicyRequest(folder=tmp_path, policies=1))[0]


def test_every_command_tells_it_the_plant_that_it_is_made_for(entry, factory, monkeypatch):
    plant = OTHER if entry.told else ACTUATOR
    monkeypatch.setattr(type(entry), "members", lambda *_: [factory])
    scenario = Scenario("other", "", 900, plant)
    ways = {
        "compare": errors(factory, 2, 900, **plant),
        "sweep": agent_cell(factory, plant, plant, 900, 2, 0)["mae"],
        "watch": mean_error(rivals.replay(entry.name, {}, scenario, 0)),
    }
    for way, found in ways.items():
        if entry.name == "nothing":
            assert np.allclose(found, IDLE), way
        else:
            assert np.all(np.array(found) < 0.7 * IDLE), (way, found)
    if factory.learns:  # in a sweep it has learnt before, on this plant
        assert np.mean(ways["sweep"]) < 0.9 * np.mean(ways["compare"])


@pytest.mark.parametrize(
    "windows", [{"setpoint_window": 7}, {"setpoint_window": 0}, {"error_window": 0}], ids=str
)
def test_it_asks_for_its_own_windows(factory, windows):
    assert errors(factory, 1, 60, **windows) == errors(factory, 1, 60)


def test_its_cost_is_known(entry, factory):
    assert (factory.cost or entry.cost).prior_knowledge


class TestOwnControllers:
    """What is no controller is named before anything runs."""

    @pytest.fixture
    def written(self, tmp_path, monkeypatch):
        monkeypatch.syspath_prepend(tmp_path)

        def write(code):
            name = f"own_{abs(hash(code))}"
            (tmp_path / f"{name}.py").write_text(code)
            return f"{name}:Mine"

        return write

    def test_a_factory_gets_what_it_asks_for(self, written):
        code = (
            "class Mine:\n"
            "    def __init__(self, {}): self.given = {}\n"
            "    def reset(self): pass\n"
            "    def act(self, o): return 0.0 * o[:, :1]\n"
        )
        some = own_factory(
            written(code.format("num_envs, seed, parameters, gain=2", "locals()"))
        )
        given = some({"delay": 3}, 3, 7).given
        assert (given["num_envs"], given["seed"], given["gain"]) == (3, 7, 2)
        assert given["parameters"].delay == 3
        everything = own_factory(written(code.format("**offered", "offered")))
        assert set(everything({}, 3, 7).given) == {
            "num_envs", "seed", "u_min", "u_max", "parameters",
        }  # fmt: skip

    def test_those_of_the_project_ask_for_their_windows(self):
        factory = own_factory("agents:PIController")
        assert errors(factory, 1, 60, setpoint_window=7) == errors(factory, 1, 60)

    @pytest.mark.parametrize("location", ["agents", "agents:", "nowhere:x", "agents:__name__"])
    def test_bad_locations(self, location):
        with pytest.raises(UsageError, match=location):
            chosen([], [f"mine={location}"])

    @pytest.mark.parametrize(
        ("code", "complaint"),
        [
            ("class Mine:\n    def act(self, o): return [[0.0]] * len(o)", "reset"),
            ("class Mine:\n    observation = 3", "observation of .* must be a dict"),
            ("class Mine:\n    observation = {'dead_zone': 0.0}", "out of .* got 'dead_zone'"),
            (
                "class Mine:\n    def reset(self): pass\n    def act(self, o): return 0.0",
                r"shape \(2, 6\).*got shape \(\)",
            ),
            (
                "class Mine:\n    def reset(self): pass\n"
                "    def act(self, o): return float(o[0]) * 0",
                "it raised TypeError",
            ),
        ],
    )
    def test_bad_ones(self, code, complaint, written):
        with pytest.raises(UsageError, match=complaint):
            chosen([], [f"mine={written(code)}"])
