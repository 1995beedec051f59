"""The page of TCLab's twin: what is identified, and what the controllers make of it."""

import numpy as np
import pytest

from benchmarks.identify.tclab_twin import command as tclab_twin
from benchmarks.identify.tclab_twin.__main__ import main
from tests.conftest import assert_the_seed_is_all_that_differs


@pytest.fixture(scope="module")
def model():
    return tclab_twin.model_of(tclab_twin.experiment())


def test_a_run_of_the_twin_is_the_same_every_time():
    assert_the_seed_is_all_that_differs(lambda seed: tclab_twin.experiment(seed).temperature)


def test_identified_plant_is_the_twin_s(model):
    # In the steady state the two heaters, at x and y above the room, obey
    # 200 Q / 5720 = x / 20 + (x - y) / 100 and y / 20 = (x - y) / 100, and sensors follow them.
    gain = np.linalg.solve([[0.06, -0.01], [-0.01, 0.06]], [200 / 5720, 0.0])[0]
    assert model.estimates["gain"].value == pytest.approx(gain, rel=0.03)
    # A sensor follows its heater with 140 s, the slowest time constant.
    assert model.estimates["time_constant"].value == pytest.approx(140.0, rel=0.1)
    assert model.estimates["delay"].value <= 2
    assert model.operating_flow == tclab_twin.HEATER


def test_tuned_controllers_control_the_twin(model):
    errors = {}
    for name, agent in tclab_twin.controllers(model).items():
        run = tclab_twin.run(agent)
        errors[name] = np.abs(run[:, 0] - run[:, 1]).mean()
    uncontrolled = np.abs(tclab_twin.SETPOINTS).mean()
    assert errors["PI, SIMC"] < 1.3 * errors["PI, course"]
    assert errors["Smith"] < 1.7 * errors["PI, course"]
    assert errors["nn-smith"] < errors["PI, course"]
    assert max(errors.values()) < 0.3 * uncontrolled


def test_page_prints_its_table(capsys):
    assert main([]) == 0
    printed = capsys.readouterr().out
    assert [line.split("  ")[0] for line in printed.splitlines()[4:-1]] == [
        "PI, SIMC", "Smith", "nn-smith", "PI, course",
    ]  # fmt: skip
