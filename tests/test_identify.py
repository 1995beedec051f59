"""A recorded log becomes a plant, and a log that is not fit for it is refused or doubted."""

import itertools
import json
import re
from contextlib import nullcontext
from dataclasses import replace
from datetime import datetime, timedelta
from functools import cache
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy import signal

from benchmarks.identify import Options, doubts, draw, main, plant_arguments, read_log
from benchmarks.lib import pictures
from benchmarks.lib.errors import UsageError
from benchmarks.loop import identification
from benchmarks.loop.identification import Log, estimates, explained_share
from mptc_gym import Parameters
from tests.conftest import ROOT

PAPER, GAIN = Parameters(), -0.6825  # degC per t/h
EXAMPLE = ROOT / "benchmarks/logs/example.csv"


def log_of(flow, dead_zone=5.0, sign=1.0):
    """Return a log of the paper's plant, whose temperature SciPy's filters make."""
    applied = sign * np.where(np.abs(flow) < dead_zone, 0.0, flow)
    noise = np.random.default_rng(701).normal(0.0, 0.2, len(flow))
    b = [*np.zeros(PAPER.delay + 1), *PAPER.b]
    temperature = signal.lfilter(b, PAPER.a, applied) + signal.lfilter(PAPER.c, PAPER.a, noise)
    return Log(flow, temperature, np.zeros((len(flow), 0)), 8.0)


def recorded(**plant):
    """Return a log that begins with a step; its flows are held for 30 to 120 samples."""
    generator = np.random.default_rng(700)
    lengths = generator.integers(30, 121, 40)
    return log_of(np.repeat(generator.uniform(-10.0, 10.0, 40), lengths)[:1200], **plant)


def identify(log, operating_flow=None):
    zones = identification.possible_zones(log.flow, operating_flow)
    return identification.identify(log, zones)


@cache
def fit_of_paper():
    """Return the fit of a log in absolute numbers; the dead zone is around 480 t/h."""
    log = recorded()
    return identify(replace(log, flow=log.flow + 480.0, temperature=log.temperature + 385.0))


class TestFit:
    def test_response_is_that_of_the_continuous_plant(self):
        elapsed = np.maximum(np.r_[:60] - 5.0 - 16.3, 0.0)  # after a step at row 5
        remaining = 30.0 * np.exp(-elapsed / 30.0) - 11.0 * np.exp(-elapsed / 11.0)
        response = identification.respond(np.repeat([0.0, 1.0], [5, 55]), 16.3, 30.0, 11.0)
        np.testing.assert_allclose(response, 1.0 - remaining / 19.0, atol=1e-12)

    def test_polynomials_of_small_reflection_coefficients_are_stable(self):
        for first, second in itertools.product([-0.97, -0.5, 0.5, 0.97], repeat=2):
            roots = np.roots(identification.stable_polynomial(first, second))
            assert np.abs(roots).max() < 1.0, (first, second)

    def test_paper_plant_is_found_in_a_log_that_begins_with_a_step(self):
        truths = {"delay": 18, "dead_zone": 5.0, "gain": GAIN, "time_constant": 161.0}
        intervals = estimates(fit_of_paper())
        for name, truth in truths.items():
            assert intervals.low[name] <= truth <= intervals.high[name], name
            assert intervals.value[name] == pytest.approx(truth, rel=0.2), name
        assert fit_of_paper().zone.centre == pytest.approx(480.0, abs=1.0)
        assert explained_share(fit_of_paper()) > 0.9
        assert doubts(fit_of_paper(), intervals, 0.9) == []

    def test_environment_with_the_arguments_is_the_plant(self):
        fit, flow = fit_of_paper(), fit_of_paper().log.flow
        arguments = json.loads(json.dumps(plant_arguments(fit, Options(EXAMPLE))))
        env = gymnasium.make("MiddlePoint-v0", **arguments | {"noise_variance": 0.0})
        env.reset()
        actions = np.interp(flow[:-1], [flow.min(), flow.max()], [-1, 1]).astype(np.float32)
        outputs = [env.step(action)[-1]["output"] for action in actions[:, np.newaxis]]
        differences = fit.simulated[1:] - fit.operating_temperature - outputs
        assert np.quantile(np.abs(differences[600:]), 0.98) < 2e-3

    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_doublet_is_enough_for_gain_and_delay(self, sign):
        flow = np.repeat([0.0, 8.0, -8.0, 0.0], [40, 100, 100, 160])
        log = log_of(flow, dead_zone=0.0, sign=sign)
        intervals = estimates(identify(replace(log, flow=flow + 300.0)))
        assert intervals.value["gain"] == pytest.approx(sign * GAIN, rel=0.1)
        assert intervals.value["delay"] == pytest.approx(18.0, abs=1.5)
        assert intervals.high["dead_zone"] > 7.0  # Three flows do not show it.

    def test_decay_from_a_start_far_from_rest_is_part_of_the_model(self):
        log = recorded(dead_zone=0.0)
        decay = 20.0 * np.exp(-np.arange(1200) / 20.1)  # with the plant's own time constant
        fit = identify(replace(log, temperature=log.temperature + decay), 0.0)
        early = slice(fit.first_row, fit.first_row + 5)
        assert fit.simulated[early] == pytest.approx(fit.log.temperature[early], abs=1.5)
        assert not fit.load_steps

    def test_step_of_a_load_is_found(self):
        log = recorded(dead_zone=0.0)
        load = 6.0 * (1.0 - np.exp(-np.maximum(np.arange(1200) - 650, 0) / 20.0))
        fit = identify(replace(log, temperature=log.temperature + load), 0.0)
        assert fit.load_steps[0] == pytest.approx(650, abs=10)
        assert fit.unknowns.gain == pytest.approx(GAIN, rel=0.05)

    def test_picture_names_the_steps_of_a_load_once(self, monkeypatch):
        figure = Figure()
        monkeypatch.setattr(pictures, "open_picture", lambda *_: nullcontext(figure))
        draw(replace(fit_of_paper(), load_steps=(300, 700)), "title", Path("log.png"))
        names = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
        assert names == ["recorded", "model", "step of a load"]


def table(line="16,5,1", mark=".", start=0):
    """Return the text of a log whose line 4 is `line`, and whose other flows are 3.

    `start` is the time of the first row, in seconds or as a `numpy.datetime64`. `mark` is the
    decimal mark of the temperatures.
    """
    rows = [f"{start + 8 * k},3,{k % 7}{mark}25" for k in range(120)]
    return "\n".join(["time,flow,temperature", *rows[:2], line, *rows[3:]])


def dated(form, first):
    """Return the text of a log with dates, of the form for `strftime`, from `first` on."""
    days = datetime.strptime(first, form)
    rows = []
    for k, row in enumerate(table().splitlines()[1:]):
        date = (days + timedelta(seconds=8 * k)).strftime(form)
        rows.append(date + row[row.index(",") :])
    return "\n".join(["time,flow,temperature", *rows])


def read(text, folder):
    (folder / "log.csv").write_text(text)
    return read_log(Options(folder / "log.csv"))


WAYS = {
    "decimal commas": table(mark="|").replace(",", ";").replace("|", ","),
    "dates": table("2026-02-01T00:00:15,5,1", start=np.datetime64("2026-01-31T23:59:59")),
    "dates that begin with the day": dated("%d.%m.%Y %H:%M:%S", "31.12.2025 23:59:00"),
    "dates that begin with the month": dated("%m/%d/%Y %H:%M:%S", "01/12/2026 23:59:00"),
    "a missing row": table().replace("\n64,3,1.25", ""),
}
REFUSED = {
    "line 4: flow must not have separators of thousands, got '1,480'": table('16,"1,480" ,1'),
    "line 4 comes 11.6 s after the line before, but most time steps are 8": table("19.6,5,1"),
    "line 10 comes .* dates begin with the month, write .* 2025-12-31": (
        dated("%m/%d/%Y %H:%M:%S", "01/02/2026 23:59:00")
    ),
}
# How the temperature of a log becomes one that asks for a warning, by words of the warning.
DOUBTS = {
    "in the last third": lambda y: y * np.linspace(2.0, -2.0, 1200),
    "a historian": lambda y: np.interp(np.r_[:1200], np.r_[:1200:20], y[::20]),
    "100 rows in succession": lambda y: np.r_[y[:99], np.full(100, 3.0), y[199:]],
    "3 temperatures lie far outside": lambda y: np.where(np.r_[:1200] % 500 == 9, -400.0, y),
}


class TestLog:
    @pytest.mark.parametrize("way", WAYS)
    def test_ways_to_write_the_same_log(self, way, tmp_path):
        log = read(WAYS[way], tmp_path)
        assert log.flow[:4].tolist() == [3.0, 3.0, 5.0, 3.0]
        assert log.temperature[[0, 2, 3, 8, 9]].tolist() == [0.25, 1.0, 3.25, 1.25, 2.25]

    @pytest.mark.parametrize("separator", [";", "\t"])
    @pytest.mark.parametrize("mark", [".", ","])
    def test_three_decimals_are_not_taken_for_thousands(self, separator, mark, tmp_path):
        rows = [("time", "flow", "temperature")]
        for k in range(120):
            flow = ("480", f"485{mark}125")[k % 2]
            rows.append((str(8 * k), flow, f"38{k % 7}{mark}250"))
        log = read("\n".join(map(separator.join, rows)), tmp_path)
        assert log.flow[:3].tolist() == [480.0, 485.125, 480.0]
        assert log.temperature[:3].tolist() == [380.25, 381.25, 382.25]

    @pytest.mark.parametrize("complaint", REFUSED)
    def test_what_cannot_be_used_is_named(self, complaint, tmp_path):
        with pytest.raises(UsageError, match=complaint):
            read(REFUSED[complaint], tmp_path)

    def test_thousands_beside_a_stopped_pump_are_refused(self, tmp_path):
        rows = [f"{8 * k};{('0', '850', '1.100')[k % 3]};{k % 7}.25" for k in range(120)]
        rows[9] = "72;;2.25"
        with pytest.raises(UsageError, match=r"line 4: flow .* got '1.100'"):
            read("\n".join(["time;flow;temperature", *rows]), tmp_path)

    @pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16"])
    def test_names_of_columns_in_any_encoding(self, encoding, tmp_path):
        path = tmp_path / "log.csv"
        path.write_text(table().replace("temperature", "Temp °C") + "\n\n", encoding=encoding)
        assert read_log(Options(path, temperature="Temp °C")).temperature[0] == 0.25

    def test_missing_flows_are_a_warning(self, tmp_path):
        text = EXAMPLE.read_text().splitlines()
        for row in range(50, 150):
            time, _, temperature = text[row].split(",")
            text[row] = f"{time},,{temperature}"
        log = read("\n".join(text), tmp_path)
        fit = identify(log)
        assert "8 % of the flows are missing" in " ".join(doubts(fit, estimates(fit), 1.0))

    def test_unknown_time_constants_and_odd_times_are_warnings(self):
        intervals = estimates(fit_of_paper())
        intervals.loc["time_constant", "high"] = 5.0 * intervals.low["time_constant"]
        fit = replace(fit_of_paper(), log=replace(fit_of_paper().log, sampling_interval=0.01))
        text = " ".join(doubts(fit, intervals, 1.0))
        assert "interval of the time constant is wide" in text
        assert "another unit than seconds" in text

    @pytest.mark.parametrize("words", DOUBTS)
    def test_what_makes_a_log_doubtful_is_a_warning(self, words):
        log = recorded()
        fit = identify(replace(log, temperature=DOUBTS[words](log.temperature)), 0.0)
        assert words in " ".join(doubts(fit, estimates(fit), explained_share(fit)))

    def test_everything_is_written(self, tmp_path):
        assert main([str(EXAMPLE), "--out", str(tmp_path)]) == 0
        for name in ("plant", "ranges"):
            arguments = json.loads((tmp_path / f"{name}.json").read_text())
            gymnasium.make("MiddlePoint-v0", **arguments).reset(seed=0)
        row = re.compile(r"\| gain +\| (\S+) +\| \[(\S+), (\S+)\]")
        value, low, high = map(float, row.search((tmp_path / "report.md").read_text()).groups())
        assert low <= min(value, -0.819) <= max(value, -0.819) <= high  # the gain was -0.819
