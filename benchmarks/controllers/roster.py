"""List one entry per controller in the roster, with all that the commands need to know of it.

A controller is added here and nowhere else: `compare`, `sweep`, `tune` and `watch` then know
it. A user's own controllers (`--agent NAME=MODULE:FACTORY`) also become such entries.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from benchmarks.controllers import engineered
from benchmarks.controllers.records import Cost, Factory, RosterEntry, Tuning

_STEP_TEST = "gain, time constant, delay"
_DATA_SHEET = f"{_STEP_TEST}, dead zone, limits"
_NETWORK = "8,894 weights for all plants"
_SEARCHED = "gains searched on the paper's plant"
_SEARCH_OF_NN = "800 trials: 566 M samples, 6 min"
_SEARCH_OF_NETWORK = "9 trainings of 46 M samples and 10 min; 110 settings by hand"

_ENTRIES = (
    RosterEntry(
        "nothing",
        "no control",
        ("#8C8C8C", "x"),
        Factory(engineered.nothing, Cost("nothing", "0", "none"), observation={}),
        compared=False,
        swept=False,
    ),
    RosterEntry(
        "nn",
        "NN (1992)",
        ("#D55E00", "o"),
        Factory(
            engineered.direct_nn,
            Cost(f"direction; {_SEARCHED}", "25 weights, 6 gains", "none", _SEARCH_OF_NN),
            learns=True,
        ),
        tuning=Tuning(
            {
                "eta": (1e-3, 10.0),
                "eta_1": (1e-3, 1.0),
                "eta_theta": (1e-4, 1.0),
                "eta_1_theta": (1e-4, 1.0),
                "input_scale": (0.02, 1.0),
                "weight_scale": (0.05, 2.0),
            }
        ),
        drawn=True,
    ),
    RosterEntry(
        "nn-frozen",
        "NN (1992), frozen",
        ("#7A3600", "o"),
        Factory(
            engineered.frozen_nn,
            Cost(
                f"direction; {_SEARCHED}",
                "25 weights, 6 gains",
                "1,200 a network",
                _SEARCH_OF_NN,
            ),
        ),
        compared=False,
    ),
    RosterEntry(
        "pi",
        "PI (1992)",
        ("#CC79A7", "s"),
        Factory(engineered.paper_pi, Cost("gains of the paper", "2", search="not stated")),
        tuning=Tuning({"kp": (0.1, 10.0), "ki": (1e-3, 1.0)}),
        drawn=True,
    ),
    RosterEntry(
        "pi-simc",
        "PI (SIMC)",
        ("#8E3B6B", "s"),
        Factory(engineered.simc_pi, Cost(_STEP_TEST, "2", "one step test", "none: a rule")),
    ),
    RosterEntry(
        "pi-searched",
        "PI (searched)",
        ("#4F1F3B", "s"),
        Factory(
            engineered.searched_pi,
            Cost(_SEARCHED, "2", "none", "800 trials: 566 M samples, 3 min"),
        ),
        swept=False,
    ),
    RosterEntry(
        "smith",
        "Smith",
        ("#56B4E9", "^"),
        Factory(
            engineered.smith,
            Cost(_DATA_SHEET, "2 gains, 5 of the model", "one step test", "none: a rule"),
        ),
        drawn=True,
    ),
    RosterEntry(
        "self-tuning",
        "self-tuning",
        ("#00B98A", "v"),
        Factory(
            engineered.self_tuning,
            Cost(
                f"{_DATA_SHEET}; delay range",
                "a bank of models, 30 settings",
                "one step test",
                "by hand, not counted",
            ),
        ),
    ),
    RosterEntry(
        "mpc",
        "MPC",
        ("#000000", "*"),
        Factory(
            engineered.mpc,
            Cost("everything but the future", "all of the plant's", "none", "none"),
        ),
        swept=False,
    ),
    RosterEntry(
        "ppo",
        "PPO",
        ("#E69F00", "D"),
        engineered.policies(
            "ppo-[0-9]*.npz",
            Cost(
                "dead zone; trained on the paper's plant",
                "388 weights",
                "5 M a policy",
                "79 trials: 121 M samples, 30 min",
            ),
        ),
        drawn=True,
    ),
    RosterEntry(
        "ppo-hard",
        "PPO (hard)",
        ("#8F6200", "D"),
        engineered.policies(
            "ppo-hard-*.npz",
            Cost(
                "trained on plants that vary",
                "12,608 weights",
                "4 M a policy",
                "43 trials: 36 M samples, 12 min",
            ),
        ),
    ),
    RosterEntry(
        "nn-smith",
        "neural Smith",
        ("#0072B2", "^"),
        engineered.law_network(
            engineered.nn_smith,
            Cost(_DATA_SHEET, _NETWORK, "one step test; 46 M, once", _SEARCH_OF_NETWORK),
        ),
        drawn=True,
    ),
    RosterEntry(
        "nn-self-tuning",
        "neural self-tuning",
        ("#00664B", "v"),
        engineered.law_network(
            engineered.nn_self_tuning,
            Cost(
                f"{_DATA_SHEET}; delay range",
                f"a bank of models, 31 settings; {_NETWORK}",
                "one step test; 46 M, once",
                _SEARCH_OF_NETWORK,
            ),
        ),
        drawn=True,
    ),
)
ROSTER = {entry.name: entry for entry in _ENTRIES}


OWN = (("#5B3FA6", "P"), ("#A08CDB", "X"), ("#B22222", "P"), ("#F08080", "X"))


def label(agent: str) -> str:
    """Return the name of a controller in tables and plots."""
    return ROSTER[agent].label if agent in ROSTER else agent


def looks(agents: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Return the colour and the marker of each controller; a user's own take turns."""
    turns = itertools.cycle(OWN)
    return {agent: ROSTER[agent].look if agent in ROSTER else next(turns) for agent in agents}
