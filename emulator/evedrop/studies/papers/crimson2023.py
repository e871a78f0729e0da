"""Crimson, Kennedy and Quevedo: noise in place of estimates, without acknowledgements.

Source: docs/papers/crimson2023.md; docs/mathematics/schemes.md, noise packets and when noise begins.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

import numpy as np

from evedrop.model.detection import ShiryaevTest
from evedrop.model.eavesdroppers import STRATEGIES
from evedrop.model.eavesdroppers.eavesdropper import Knowledge
from evedrop.model.local_filter import LocalFilter, settled
from evedrop.model.plant import Plant
from evedrop.model.process import Floats, Process, Trajectory
from evedrop.model.receiver import Receiver, Reception
from evedrop.model.schedule import PACKETS
from evedrop.model.schemes.noise import Noise
from evedrop.model.slot.link import deliveries, link_of
from evedrop.model.streams import Batch, BlockReader, root_of_seed, stream_key
from evedrop.model.theory.covariances import NOBODY, limit, lyapunov
from evedrop.studies.papers.reproduction import NumberVerdict, Paper, Progress, PublishedNumber

_A = np.array([[0.5, 0.1], [0.4, 0.6]])
_SMALL = 0.01 * np.eye(2)
_NO_INPUTS, _UNLIMITED = np.zeros((2, 0)), np.full(2, np.inf)
PLANT = Plant(
    _NO_INPUTS, _NO_INPUTS, _SMALL, np.zeros(2), np.zeros(0), np.zeros(0), -_UNLIMITED, _UNLIMITED, np.eye(2), _SMALL
)
"""Process noise 0.01 I, measured with C = I in noise of 0.01 I."""
LOSSES, NOISE = 0.2, 0.7
"""The loss probabilities γ̄ = γ̄ᵉ and the probability μ of noise in our simulation; we do not know those of their figures."""
DETECTOR = ShiryaevTest(normal=0.2, raised=0.5, hazard=0.01, risk=0.01)
"""Our example of a detector; we do not know theirs."""
_START = 20
"""Slots that are not counted: the filter and the errors have then settled."""
_SLIDES = "slides"


def open_loop() -> Floats:
    """P_OL, (n, n): the covariance of the state."""
    return limit(Process(_A, _SMALL, _SMALL), NOBODY)


def filter_error() -> Floats:
    """P̄, (n, n): the covariance of the error of the sensor's filter, settled."""
    return settled(Process(_A, _SMALL, _SMALL), PLANT).covariance


def published_error(losses: float, mu: float, taken: Floats | None = None) -> float:
    """Tr EP by the published recursion; taken: P_n for an eavesdropper that takes noise for the estimate, None without one."""
    P, process = filter_error(), Process(_A, _SMALL, _SMALL)
    kept = losses if taken is not None else 1.0 - (1.0 - losses) * (1.0 - mu)
    source = (1.0 - losses) * (1.0 - mu) * P + kept * _SMALL
    if taken is not None:
        source = source + (1.0 - losses) * mu * taken
    return float(np.trace(lyapunov(Process(process.A, source, _SMALL), kept)))


def noise_threshold(legitimate_losses: float, losses: float) -> float:
    """The least μ for which the error of an eavesdropper that takes noise for the estimate exceeds the estimator's, by bisection.

    For an eavesdropper with fewer losses than the legitimate estimator; otherwise it is 0.
    """
    taken = open_loop() + filter_error()
    low, high = 0.0, 1.0
    for _ in range(50):
        mu = 0.5 * (low + high)
        ahead = published_error(losses, mu, taken) <= published_error(legitimate_losses, mu)
        low, high = (mu, high) if ahead else (low, mu)
    return high


@final
class Crimson2023(Paper):
    """The example of the slides, the published recursions against simulation, and receivers that test the packets."""

    title = "Remote State Estimation with Privacy Against (Active) Eavesdroppers"
    authors = "M. J. Crimson, J. M. Kennedy, D. E. Quevedo"
    published = "IFAC World Congress, 2023, arXiv 2211.13411; arXiv 2308.08790, 2023"

    def rows(self, quick: bool, progress: Progress) -> Iterator[PublishedNumber]:
        """The slides' three numbers, the recursions, the unmasking of the noise, and the detector."""
        yield from _example()
        trials, slots = (200, 150) if quick else (2000, 600)
        progress("noise in place of estimates")
        yield from _recursions(trials, slots)
        progress("the detector")
        yield from _detector(1000 if quick else 20_000)


def _example() -> Iterator[PublishedNumber]:
    ours = float(np.trace(open_loop()))
    yield PublishedNumber.compared(_SLIDES, "tr P_OL, without packets", 0.0388, ours, absolute=5e-5)
    ours = float(np.trace(filter_error()))
    reason = (
        "the Riccati equation has one solution for A, C = I and Q = R = 0.01 I, which is ours; 0.0114 results from R = 0.0107 I; "
        "we do not know how the slides arrive at it"
    )
    yield PublishedNumber.stated(_SLIDES, "tr P̄ of the filter", 0.0114, ours, NumberVerdict.NOT_PUBLIC, reason)
    near, far = noise_threshold(0.4, 0.25), noise_threshold(0.5, 0.3)
    reason = (
        "the threshold on μ depends on both loss probabilities, which we do not know: many pairs give 0.14, such "
        f"as legitimate 0.4 and 0.25 for the eavesdropper ({near:.3f}); with 0.5 and 0.3 it is {far:.3f}, with equal ones 0"
    )
    quantity = "the μ above which the eavesdropper's error exceeds the legitimate estimator's"
    yield PublishedNumber.stated(_SLIDES, quantity, 0.14, "0 to 1", NumberVerdict.NOT_PUBLIC, reason)


def _recursions(trials: int, slots: int) -> Iterator[PublishedNumber]:
    where = f"γ̄ = {LOSSES}, μ = {NOISE}"
    published = mean_errors(filter_error().tolist(), trials, slots)
    full = mean_errors(PACKETS, trials, slots)
    formulas = {
        "user": published_error(LOSSES, NOISE),
        "naive": published_error(LOSSES, NOISE, open_loop() + filter_error()),
    }
    for name, quantity in (
        ("user", "tr EP of the legitimate estimator"),
        ("naive", "tr EPᵉ of an eavesdropper that is unaware"),
    ):
        mean, error = published[name]
        yield PublishedNumber.compared(
            where, f"{quantity}, by simulation", formulas[name], mean, error, errors=4.0, printed=False
        )
    P_OL = float(np.trace(open_loop()))
    reason = f"no eavesdropper of the paper tests packets; one that hears nothing has {P_OL:.4f}"
    for name in ("power-test", "bayesian"):
        for covariance, means_of in (("P̄", published), ("that of the estimates", full)):
            mean, error = means_of[name]
            yield PublishedNumber.stated(
                where,
                f"{name}, noise of covariance {covariance}",
                None,
                mean,
                NumberVerdict.NOT_COMPARABLE,
                reason,
                error,
            )


def mean_errors(noise_covariance: object, trials: int, slots: int) -> dict[str, tuple[float, float]]:
    """Receiver → its mean squared error against the true state, and the standard error of that, from the means of trials."""
    root, batch = root_of_seed(2023), Batch(_START + slots, trials)
    keys = {name: stream_key(root, name) for name in ("process", "measurement", "schedule", "noise")}
    truth = Process(_A, _SMALL, open_loop())
    step = settled(truth, PLANT)
    network = Process(_A, step.innovation, open_loop() - step.covariance)
    scheme = Noise(network, 1.0 - NOISE, noise_covariance)
    trajectory, local = Trajectory(truth, keys["process"], batch), LocalFilter(truth, PLANT, keys["measurement"], batch)
    encoder = scheme.encoder(keys, batch)
    knowledge = Knowledge(network, scheme.state_probability, {}, {}, None, scheme.noise_distribution)
    receivers: dict[str, Receiver] = {"user": scheme.estimator(keys, batch)}  # the name of its link's stream
    receivers |= {name: STRATEGIES[name](knowledge, batch) for name in ("naive", "power-test", "bayesian")}
    spec = {"model": "bernoulli", "quality": 1.0 - LOSSES}
    links = {
        name: deliveries(link_of(spec, stream_key(root, f"link/{name}"), batch), batch.slots) for name in receivers
    }
    beliefs = {name: receiver.prior() for name, receiver in receivers.items()}
    totals = {name: np.zeros(trials) for name in receivers}
    for k in range(batch.slots):
        x = trajectory.advance()
        packet = encoder.encode(k, local.take(k, x, np.zeros((2, 1))), local.predicted)
        for name, receiver in receivers.items():
            gamma = next(links[name])
            beliefs[name] = receiver.step(k, beliefs[name], Reception(gamma, packet.z))
            if k >= _START:
                totals[name] += ((x - beliefs[name].x_hat) ** 2).sum(axis=0)
    means = {name: total / slots for name, total in totals.items()}
    return {name: (float(errors.mean()), float(errors.std(ddof=1) / np.sqrt(trials))) for name, errors in means.items()}


def _detector(trials: int) -> Iterator[PublishedNumber]:
    rates = f"losses from {DETECTOR.normal:g} to {DETECTOR.raised:g}, κ = {DETECTOR.hazard:g}, h = {DETECTOR.risk:g}"
    false, delay = detection(DETECTOR, trials)
    held = false[0] - 4.0 * false[1] <= DETECTOR.risk
    yield PublishedNumber.stated(
        "detector",
        f"fraction of false alarms, {rates}",
        f"at most {DETECTOR.risk:g}",
        false[0],
        NumberVerdict.FORMULA if held else NumberVerdict.DIFFERS,
        "" if held else "more alarms are false than h allows",
        false[1],
        printed=False,
    )
    reason = "we do not know the rates, κ and h of their example"
    yield PublishedNumber.stated(
        "detector", f"mean delay in slots, {rates}", None, delay[0], NumberVerdict.NOT_PUBLIC, reason, delay[1]
    )


def detection(test: ShiryaevTest, trials: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """The fraction of false alarms, and the mean number of slots from the change to a true alarm, with standard errors.

    The change comes in slot k with probability κ(1−κ)^k.
    """
    slots = round(20.0 / test.hazard)
    reader = BlockReader(stream_key(root_of_seed(2023), "link"), Batch(slots, trials), 2)
    p, changed = test.start(trials), np.zeros(trials, np.bool_)
    change, alarm = np.full(trials, slots), np.full(trials, slots)
    for k in range(slots):
        event, loss = reader.uniforms(range(k, k + 1))[0]
        change = np.where(~changed & (event < test.hazard), k, change)
        changed = changed | (event < test.hazard)
        p = test.step(p, loss < np.where(changed, test.raised, test.normal))
        alarm = np.where(test.alarms(p) & (alarm == slots), k, alarm)
        if (alarm < slots).all():
            break
    false = alarm < change
    delays = (alarm - change + 1.0)[~false]
    return (
        (float(false.mean()), float(false.std(ddof=1) / np.sqrt(trials))),
        (float(delays.mean()), float(delays.std(ddof=1) / np.sqrt(len(delays)))),
    )
