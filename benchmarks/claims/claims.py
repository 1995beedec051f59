"""List the paper's claims in words, each with the function that examines the claim.

The paper is that of Cui and Shin (1992), whose controller is a neural network (NN) that learns
online.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from agents.pi import SEARCHED_GAINS
from benchmarks.claims import examinations
from benchmarks.claims.examinations import PAPER_PI, Findings
from benchmarks.claims.findings import Finding
from benchmarks.claims.runs import Batch


class Claim(NamedTuple):
    """A claim of the paper, with the function that examines the claim."""

    section: str  # where the claim is in the paper
    statement: str  # the claim in one sentence
    method: str  # how the claim is examined, and what its words mean, for the report
    examine: Callable[[Batch], Findings]  # function that returns the findings from a batch


CLAIMS = {
    "convergence": Claim(
        "Section 5, result 1",
        "The weights converge within 150 sampling intervals",
        "The weights have converged when their distance to their final values stays below 5 "
        "% of the distance at the start of the run, for at least the last 100 samples of the "
        "run.",
        examinations.convergence,
    ),
    "dead-zone": Claim(
        "Section 5, result 2",
        "A dead zone of 7 t/h costs performance seriously, and the NN still works well",
        "A run has settled if the error stays within 5 % of the set point over the last 50 "
        "samples. A dead zone of 7 t/h costs performance seriously if the mean error is at "
        "least a fifth larger than with the paper's usual dead zone of 5 t/h. Both dead zones "
        "are half widths.",
        examinations.dead_zone,
    ),
    "noise": Claim(
        "Section 5, result 3",
        "The NN works with noise, R = 0.5, without special consideration for it",
        "R is the variance of the noise, °C². The NN works if three criteria are met: the "
        "average error is at most 5 % of the set point, the temperature varies at most a fifth "
        "more than without control, and the mean error is smaller than without control.",
        examinations.noise,
    ),
    "pi-gains": Claim(
        "Section 5, after Fig. 10",
        "The paper's PI controller oscillates; a lower Kp brings no notable improvement, a "
        "higher one instability",
        "The paper's PI controller has the proportional gain Kp = 2.2 and the integral gain "
        "Ki = 0.3. The temperature y oscillates if it varies by at least 10 % of the set "
        "point, peak to peak, over the last 300 samples. The lower gains are Kp from 0.1 to "
        "2.2, and an improvement is notable if the mean error is at least 5 % smaller. The "
        "higher gain is twice the paper's Kp.",
        examinations.pi_gains,
    ),
    "nn-against-paper-pi": Claim(
        "Section 5, Figs 5 and 10, 8 and 11",
        "The NN is much better than the PI controller with the paper's gains",
        f"The PI controller has the gains Kp = {PAPER_PI['kp']:g} and Ki = "
        f"{PAPER_PI['ki']:g}. The NN is much better if its mean error is at least a fifth "
        "smaller in the same noise.",
        partial(examinations.against_pi, gains=PAPER_PI),
    ),
    "nn-against-searched-pi": Claim(
        "Section 5, end of the comparison",
        "No PI controller can perform well here: the NN is much better than one with searched "
        "gains, too",
        f"The PI controller has the gains Kp = {SEARCHED_GAINS['kp']:g} and Ki = "
        f"{SEARCHED_GAINS['ki']:g}, which were searched with the same budget as the learning "
        "rates of the NN. The NN is much better if its mean error is at least a fifth "
        "smaller in the same noise.",
        partial(examinations.against_pi, gains=SEARCHED_GAINS),
    ),
    "direction": Claim(
        "Section 5, on (27)",
        "Training with -D(G) diverges at once",
        "D(G) is the sign of the plant's gain, so that -D(G) is the wrong sign. A run diverges "
        "at once if the temperature exceeds, within 150 samples, 90 % of the largest deviation "
        "that the flow can cause. According to the paper, the weights converge within 150 "
        "samples if the network has the right sign.",
        examinations.wrong_direction,
    ),
    "six-nodes": Claim(
        "Section 5, Fig. 12",
        "Six hidden nodes are no better than three",
        "Six nodes are better if the mean error is at least 5 % smaller than with three nodes. "
        "The gains are the learning rates of a network. Networks with six nodes run with the "
        "gains of the paper's network ('the same gains'), and with half of these gains for the "
        "weights and thresholds of hidden nodes ('gains in proportion').",
        partial(examinations.other_shapes, shapes={"6 hidden nodes": {"nodes": 6}}),
    ),
    "more-inputs": Claim(
        "Section 5, on the choice of inputs",
        "More delayed inputs are not superior",
        "The paper's network observes the latest three set points and the latest three errors. "
        "Here, networks observe the latest 6 or 20 values of each signal. More inputs are "
        "superior if the mean error is at least 5 % smaller. The gains are the learning rates "
        "of a network. The networks run with the gains of the paper's network ('the same "
        "gains'), and with smaller gains for the weights of the inputs: half as large with 6 "
        "values, and 3/20 as large with 20 values ('gains in proportion').",
        partial(
            examinations.other_shapes,
            shapes={f"{n} set points and errors": {"length": n} for n in (6, 20)},
        ),
    ),
    "reliability": Claim(
        "Section 5, last sentence",
        "More hidden nodes improve reliability",
        "After 600 samples at a set point of 5 °C, one hidden node fails: its output stays at "
        "0, or at 1, and the other nodes continue to learn. More nodes improve reliability if "
        "the mean error after the failure is at least 5 % smaller than with three nodes. A run "
        "has settled if the error stays within 5 % of the set point over 50 samples. The gains "
        "are the learning rates of a network. The networks run with the gains of the paper's "
        "network ('the same gains'), and with smaller gains for the weights and thresholds of "
        "hidden nodes: half as large with six nodes, and a quarter as large with twelve nodes "
        "('gains in proportion').",
        examinations.reliability,
    ),
    "keep-learning": Claim(
        "Section 4, last paragraph",
        "On a plant that changes the weights must keep being updated",
        "The network learns on the paper's plant for 1,200 samples of the square wave. Then "
        "the gain or the delay (in samples) of the plant changes, and the network controls the "
        "changed plant for 1,200 samples, from rest. In one run, the weights continue to "
        "learn; in another run, the weights are frozen. Learning is necessary if the mean "
        "error is at least 5 % smaller with learning weights than with frozen weights.",
        examinations.keep_learning,
    ),
    "direction-only": Claim(
        "Abstract and Section 6",
        "The direction of the response is all that need be known of a plant",
        "The direction is the sign of the plant's gain. The paper's network, with the learning "
        "rates of the paper's plant, controls other plants with the same direction, whose "
        "gains and time constants are multiples of those of the paper's plant. A run has "
        "settled if the error stays within 5 % of the set point over the last 50 samples. The "
        "network works on a plant if at least 90 % of the runs settle.",
        examinations.direction_only,
    ),
    "figures": Claim(
        "Section 5, Figs 5 to 12",
        "The curves of the figures themselves",
        "The text of the paper does not say with which set points, gains, initial weights and "
        "noise the curves were made. The following command draws the responses of both "
        "controllers on the same plants: python -m benchmarks.compare",
        lambda batch: (),
    ),
}


def examined(name: str, batch: Batch) -> list[Finding]:
    """Call the function that examines a claim, and return all findings about the claim."""
    return list(CLAIMS[name].examine(batch))
