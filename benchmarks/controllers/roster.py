"""The roster: one entry for each controller, with all that any command has to know of it.

A controller is added here and nowhere else. `compare`, `sweep`, `tune`, `train` and `watch`
know it then. A user's own controllers (`--agent NAME=MODULE:FACTORY`) become such entries, too.
"""

from __future__ import annotations

from benchmarks.controllers import engineered, pretrained
from benchmarks.controllers.records import Cost, Factory, RosterEntry, Tuning

_STEP_TEST = "gain, time constant, delay"
_NETWORK = "8,894 weights for all plants"
_SEARCH = "566 M (search)"

ROSTER: dict[str, RosterEntry] = {
    entry.name: entry
    for entry in (
        RosterEntry(
            "nothing",
            "no control",
            Factory(engineered.nothing, observation={}),
            Cost("nothing", "0", "none"),
            compared=False,
        ),
        RosterEntry(
            "nn",
            "NN",
            Factory(engineered.direct_nn, learns=True),
            Cost(
                "direction; gains searched on the paper's plant", "25 weights, 6 gains", _SEARCH
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
            swept=True,
            drawn=True,
        ),
        RosterEntry(
            "nn-frozen",
            "NN, frozen",
            Factory(engineered.frozen_nn),
            Cost(
                "direction; gains searched on the paper's plant",
                "25 weights, 6 gains",
                f"{_SEARCH}, 1,200 a network",
            ),
            compared=False,
            swept=True,
        ),
        RosterEntry(
            "pi",
            "PI",
            Factory(engineered.paper_pi, code="agents.pi"),
            Cost("gains of the paper", "2", "not stated"),
            told=False,
            tuning=Tuning({"kp": (0.1, 10.0), "ki": (1e-3, 1.0)}),
            swept=True,
            drawn=True,
        ),
        RosterEntry(
            "pi-simc",
            "PI, SIMC",
            Factory(engineered.simc_pi),
            Cost(_STEP_TEST, "2", "one step test"),
            swept=True,
        ),
        RosterEntry(
            "pi-searched",
            "PI, searched",
            Factory(engineered.searched_pi),
            Cost("gains searched on the paper's plant", "2", _SEARCH),
            told=False,
        ),
        RosterEntry(
            "smith",
            "Smith",
            Factory(engineered.smith),
            Cost(
                f"{_STEP_TEST}, dead zone, limits", "2 gains, 5 of the model", "one step test"
            ),
            swept=True,
            drawn=True,
        ),
        RosterEntry(
            "self-tuning",
            "self-tuning",
            Factory(engineered.self_tuning),
            Cost(
                f"{_STEP_TEST}, dead zone, limits; delay range",
                "a bank of models, 30 settings",
                "one step test",
            ),
            swept=True,
        ),
        RosterEntry(
            "mpc",
            "MPC",
            Factory(engineered.mpc),
            Cost("everything but the future", "all of the plant's", "none"),
        ),
        RosterEntry(
            "ppo",
            "PPO",
            pretrained.ppo_policies,
            told=False,
            trained=True,
            tuning=Tuning(
                {
                    "learning_rate": (7e-4, 2e-3),
                    "gamma": (0.96, 0.985),
                    "noise_variance": (0.1, 0.8),
                    "setpoint_amplitude": (5.0, 7.0),
                },
                trials=9,
                startup=5,
                finalists=2,
                # Without integral action a policy does not settle to the last; only its
                # errors count.
                penalty=0.0,
                members=(2, 4),
                train=pretrained.tuned_policy,
            ),
            swept=True,
            drawn=True,
        ),
        RosterEntry(
            "ppo-randomised",
            "PPO, randomised",
            pretrained.randomised_policies,
            told=False,
            trained=True,
            compared=False,
        ),
        RosterEntry(
            "nn-smith",
            "NN, told",
            pretrained.told_network(engineered.nn_smith),
            Cost(f"{_STEP_TEST}, dead zone, limits", _NETWORK, "one step test; 46 M, once"),
            swept=True,
            drawn=True,
        ),
        RosterEntry(
            "nn-self-tuning",
            "NN, self-tuning",
            pretrained.told_network(engineered.nn_self_tuning),
            Cost(
                f"{_STEP_TEST}, dead zone, limits; delay range",
                f"a bank of models, 31 settings; {_NETWORK}",
                "one step test; 46 M, once",
            ),
            swept=True,
            drawn=True,
        ),
    )
}


def label(agent: str) -> str:
    """Return the name of a controller in tables and plots."""
    return ROSTER[agent].label if agent in ROSTER else agent
