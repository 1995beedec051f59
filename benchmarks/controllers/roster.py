"""The roster: one record for each controller, with all that any command has to know of it.

A controller is added here and nowhere else. `compare`, `sweep`, `tune`, `train` and `watch`
know it then. A user's own controllers (`--agent NAME=MODULE:FACTORY`) become such records, too.
"""

from __future__ import annotations

from benchmarks.controllers.records import Account, Controller, Tuning

_STEP_TEST = "gain, time constant, delay"

ROSTER: dict[str, Controller] = {
    controller.name: controller
    for controller in (
        Controller(
            "nothing",
            "no control",
            "benchmarks.controllers.engineered:Nothing",
            account=Account("nothing", "0", "none"),
            compared=False,
        ),
        Controller(
            "nn",
            "NN",
            "benchmarks.controllers.engineered:direct_nn",
            in_service="benchmarks.controllers.commissioned:learning_network",
            account=Account(
                "direction; gains searched on the paper's plant",
                "25 weights, 6 gains",
                "566 M (search)",
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
        Controller(
            "nn-frozen",
            "NN, frozen",
            "benchmarks.controllers.commissioned:frozen_network",
            account=Account(
                "direction; gains searched on the paper's plant",
                "25 weights, 6 gains",
                "566 M (search), 1,200 a network",
            ),
            compared=False,
            swept=True,
        ),
        Controller(
            "pi",
            "PI",
            "agents:PIController",
            account=Account("gains of the paper", "2", "not stated"),
            tuning=Tuning({"kp": (0.1, 10.0), "ki": (1e-3, 1.0)}),
            swept=True,
            drawn=True,
        ),
        Controller(
            "pi-simc",
            "PI, SIMC",
            "benchmarks.controllers.engineered:simc_pi",
            account=Account(_STEP_TEST, "2", "one step test"),
            swept=True,
        ),
        Controller(
            "pi-searched",
            "PI, searched",
            "benchmarks.controllers.engineered:searched_pi",
            account=Account("gains searched on the paper's plant", "2", "566 M (search)"),
        ),
        Controller(
            "smith",
            "Smith",
            "benchmarks.controllers.engineered:smith",
            account=Account(
                f"{_STEP_TEST}, dead zone, limits", "2 gains, 5 of the model", "one step test"
            ),
            swept=True,
            drawn=True,
        ),
        Controller(
            "self-tuning",
            "self-tuning",
            "benchmarks.controllers.engineered:self_tuning",
            account=Account(
                f"{_STEP_TEST}, dead zone, limits; delay range",
                "a bank of models, 30 settings",
                "one step test",
            ),
            swept=True,
        ),
        Controller(
            "mpc",
            "MPC",
            "benchmarks.controllers.engineered:mpc",
            account=Account("everything but the future", "all of the plant's", "none"),
        ),
        Controller(
            "ppo",
            "PPO",
            trained="benchmarks.train.ppo:members",
            account=Account("dead zone; delay, by the past actions it sees"),
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
                make="benchmarks.train.ppo:tuned",
            ),
            swept=True,
            drawn=True,
        ),
        Controller(
            "ppo-randomised",
            "PPO, randomised",
            trained="benchmarks.train.ppo:randomised_members",
            account=Account("dead zone; delay range, by the past actions it sees"),
            compared=False,
            swept=False,
        ),
        Controller(
            "nn-dpc",
            "NN, trained through the plant",
            "benchmarks.controllers.pretrained:nn_dpc",
            account=Account("the paper's plant: its equations, ranges of dead zone and noise"),
            swept=True,
            drawn=True,
        ),
        Controller(
            "nn-adaptive",
            "NN, trained on many plants",
            "benchmarks.controllers.pretrained:nn_adaptive",
            account=Account("the class of plants: equations, and ranges of their numbers"),
            swept=True,
            drawn=True,
        ),
    )
}


def label(agent: str) -> str:
    """Return the name of a controller in tables and plots."""
    return ROSTER[agent].label if agent in ROSTER else agent
