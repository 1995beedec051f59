"""The comparison of the linear rules along their robustness."""

import numpy as np
import pandas as pd
import pytest

from benchmarks import robustness
from benchmarks.controllers.roster import ROSTER
from benchmarks.controllers.spec import ROBUSTNESS
from benchmarks.loop.rollout import mean_error
from benchmarks.loop.scenarios import SCENARIOS
from mptc_gym.evaluation import SEED


def test_table_and_picture_are_of_rules_at_one_sensitivity(tmp_path, monkeypatch):
    monkeypatch.setattr(robustness, "SENSITIVITIES", (1.4, ROBUSTNESS))
    words = f"--runs 2 --jobs 1 --out {tmp_path}"
    assert robustness.main(words.split()) == 0
    rows = pd.read_csv(tmp_path / "robustness.csv")
    assert len(rows) == 3 * 2 * len(robustness.CASES)
    for (name, ms), of_rule in rows.groupby(["agent", "Ms"]):
        spec = ROSTER[name]
        # What is in the table is the loop with this Ms, and what it does.
        controller = spec.with_gains({spec.tuned_by: of_rule[spec.tuned_by].iloc[0]})
        assert controller.loop({}).sensitivity() == pytest.approx(ms, rel=1e-3)
        scenario = SCENARIOS["constant"]
        run = controller.run(scenario.arguments, scenario.samples, 1, SEED)
        error = of_rule.set_index("case")["mean_error"]["constant"]
        assert mean_error(run)[0] == pytest.approx(error, rel=1e-3)
    # The filter of Dahlin's controller acts on loads alone; a slower Smith is slower in all.
    errors = rows.pivot(index=["agent", "case"], columns="Ms", values="mean_error")
    slower = errors[1.4] / errors[ROBUSTNESS]
    assert slower["dahlin", "square"] == pytest.approx(1.0, abs=0.01)
    assert slower["dahlin", "load"] > 1.1
    assert (slower["smith"][["square", "constant", "load"]] > 1.1).all()
    page = (tmp_path / "report.md").read_text()
    assert "| Smith " in page
    assert "0 to 52" in page
    assert np.isfinite(rows["ratio"]).all()
    assert (tmp_path / "robustness.png").stat().st_size > 10_000
