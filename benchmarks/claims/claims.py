"""The claims that the paper makes, and how each is examined."""

from __future__ import annotations

from functools import partial

from benchmarks.claims import examinations as examine
from benchmarks.claims.examinations import PAPER_PI, SEARCHED_PI
from benchmarks.claims.runs import hidden_nodes, longer_windows
from benchmarks.claims.verdicts import Claim

CLAIMS: dict[str, Claim] = {
    claim.name: claim
    for claim in (
        Claim(
            "convergence",
            "Section 5, result 1",
            "The weights converge within 150 sampling intervals",
            "Converged: the distance of all weights to where they end stays below 5 % of what "
            "it was at the start, for the last 100 samples at the least.",
            examine.convergence,
        ),
        Claim(
            "dead-zone",
            "Section 5, result 2",
            "A dead zone of 7 t/h costs performance seriously, and the NN still works well",
            "Settled: the error stays within 5 % of the set point over the last 50 samples. "
            "Seriously: the mean error is larger by a fifth or more.",
            examine.dead_zone,
        ),
        Claim(
            "noise",
            "Section 5, result 3",
            "The NN works with noise, R = 0.5, without special consideration for it",
            "It must hold the set point on average, to 5 %; must not make the temperature vary "
            "much more than it does without control; and must be better than doing nothing.",
            examine.noise,
        ),
        Claim(
            "pi-gains",
            "Section 5, after Fig. 10",
            "The paper's PI controller oscillates; a lower Kp brings no notable improvement, a "
            "higher one instability",
            "Oscillates: by 10 % of the set point and more, peak to peak, after 15 minutes and "
            "to the end. Lower: Kp from 0.1 to 2.2, with Ki = 0.3; notable is 5 % of the mean "
            "error. Higher: twice the paper's Kp.",
            examine.pi_gains,
        ),
        Claim(
            "nn-against-paper-pi",
            "Section 5, Figs 5 and 10, 8 and 11",
            "The NN is much better than the PI controller with the paper's gains",
            f"Kp = {PAPER_PI[0]:g}, Ki = {PAPER_PI[1]:g}. Much better: the mean error is "
            "smaller by a fifth or more, in the same noise.",
            partial(examine.versus_pi, PAPER_PI),
        ),
        Claim(
            "nn-against-searched-pi",
            "Section 5, end of the comparison",
            "No PI controller can perform well here: the NN is much better than one with "
            "searched gains, too",
            f"Kp = {SEARCHED_PI[0]:g}, Ki = {SEARCHED_PI[1]:g}, searched with the same budget "
            "as the network's gains. Otherwise as above.",
            partial(examine.versus_pi, SEARCHED_PI),
        ),
        Claim(
            "direction",
            "Section 5, on (27)",
            "Training with -D(G) diverges at once",
            "At once: within the 150 samples that the right sign is said to take.",
            examine.direction,
        ),
        Claim(
            "six-nodes",
            "Section 5, Fig. 12",
            "Six hidden nodes are no better than three",
            "With the same gains, and with gains in proportion: half as large for the weights "
            "and thresholds of hidden nodes. Better: the mean error is smaller by 5 % or more.",
            partial(examine.against_the_paper, [hidden_nodes(6)]),
        ),
        Claim(
            "more-inputs",
            "Section 5, on the choice of inputs",
            "More delayed inputs are not superior",
            "Six and twenty set points and errors, not three; with the same gains, and with "
            "gains in proportion: for the weights of the inputs smaller by as much as there "
            "are more inputs. Better: as above.",
            partial(examine.against_the_paper, [longer_windows(n) for n in (6, 20)]),
        ),
        Claim(
            "reliability",
            "Section 5, last sentence",
            "More hidden nodes improve reliability",
            "After 600 samples at set point 5 the output of a hidden node stays at 0, or at 1, "
            "and the others go on learning. Reliable: the mean error after that is smaller "
            "than with three nodes by 5 % or more. Gains in proportion: as above.",
            examine.node_failure,
        ),
        Claim(
            "keep-learning",
            "Section 4, last paragraph",
            "On a plant that changes the weights must keep being updated",
            "The network learns on the paper's plant for 1,200 samples of the square wave; "
            "then the plant changes, and for 1,200 more, from rest, the weights learn on or "
            "stay as they are.",
            examine.changing_plant,
        ),
        Claim(
            "direction-only",
            "Abstract and Section 6",
            "The direction of the response is all that need be known of a plant",
            "The same gains on other plants with the same direction. Settled: as "
            "above; works: in at least 90 % of the draws.",
            examine.other_plants,
        ),
        Claim(
            "figures",
            "Section 5, Figs 5 to 12",
            "The curves of the figures themselves",
            "The text gives neither their set points nor the gains, initial weights and noise "
            "behind them. `python -m benchmarks.figures` draws counterparts.",
            examine.nothing,
        ),
    )
}
