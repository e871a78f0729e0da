"""Lücke, Lu and Quevedo: a state-secrecy code whose acknowledgements are flipped.

Source: docs/papers/luecke2022.md; docs/mathematics/attacks.md, flipped acknowledgements.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from evedrop.model.acknowledgements import AckChannel, AckChannelSpec, rates_of
from evedrop.model.process import Floats, Process
from evedrop.model.receiver import Reception
from evedrop.model.reference_code import ReferenceCode, ReferenceReceiver
from evedrop.model.schemes.mixed_packets import (
    MixedEncoder,
    RandomCode,
    RandomCodeEncoder,
    ThresholdCode,
    ThresholdCodeEncoder,
    forged_fraction,
)
from evedrop.model.schemes.scheme import Scheme
from evedrop.model.slot.link import deliveries, link_of
from evedrop.model.streams import Batch, root_of_seed, stream_key
from evedrop.studies.papers.reproduction import NumberVerdict, Paper, Progress, PublishedNumber

MU, FLIP = 0.8, 0.1
"""The quality of the legitimate link and the probability of a flip, in all examples here."""
STABLE = Process(np.array([[0.9]]), np.array([[1.0]]), np.array([[1.0 / 0.19]]))
UNSTABLE = Process(
    np.array([[1.2, 0.1], [0.0, 0.5]]), np.array([[0.6, 0.2], [0.2, 0.5]]), np.array([[0.6, 0.2], [0.2, 0.5]])
)

_THEIR_SLOTS = 200_000
_RUN_SLOTS = 50_000
"""The slots of one of their runs in the search for a policy; they averaged several runs."""
_START = 50
"""Slots that are not counted: the distribution of the covariances has then forgotten the start."""
_SIDE_BY_SIDE = 2500
"""Trials that are simulated at once."""


@dataclass(frozen=True)
class TransmissionPolicy:
    """When the sensor sends the state: by a coin (α), or where its belief exceeds a threshold (θ)."""

    alpha: float | None = None
    theta: float | None = None

    def __str__(self) -> str:
        """α or θ with its value."""
        return f"θ = {self.theta}" if self.alpha is None else f"α = {self.alpha}"

    def scheme(self, process: Process) -> Scheme:
        """The scheme of this project with the policy."""
        if self.alpha is not None:
            return RandomCode(process, self.alpha)
        return ThresholdCode(process, float(self.theta or 0.0), MU, FLIP)

    def encoder(self, code: ReferenceCode, n: int, batch: Batch, key: bytes) -> MixedEncoder:
        """The sensor's side."""
        if self.alpha is not None:
            return RandomCodeEncoder(code, n, batch, key, self.alpha)
        return ThresholdCodeEncoder(code, n, batch.trials, float(self.theta or 0.0), forged_fraction(MU, FLIP))


@dataclass(frozen=True)
class _Published:
    """Their mean traces with one policy."""

    policy: TransmissionPolicy
    legitimate: tuple[float, ...]
    """One for each quality of the eavesdropper's link, on which the legitimate estimator does not depend."""
    eavesdropper: Mapping[float, float]
    """The quality of its link → its mean trace."""


STABLE_NUMBERS = (
    _Published(TransmissionPolicy(alpha=0.1), (0.8697,), {0.8: 2.3167}),
    _Published(TransmissionPolicy(alpha=0.3), (0.3676, 0.3601), {0.8: 0.8527, 0.6: 1.7086}),
    _Published(TransmissionPolicy(alpha=0.5), (0.2795,), {0.8: 0.4864}),
    _Published(TransmissionPolicy(theta=0.05), (0.2593,), {0.8: 0.3965}),
    _Published(TransmissionPolicy(theta=0.1), (0.3082, 0.3039), {0.8: 0.7555, 0.6: 1.6844}),
    _Published(TransmissionPolicy(theta=0.2), (0.4664,), {0.8: 1.6717}),
)
UNSTABLE_NUMBERS = (
    _Published(TransmissionPolicy(alpha=0.305), (1.97,), {0.8: 15.0}),
    _Published(TransmissionPolicy(theta=0.188), (1.96,), {0.8: 1154.0}),
)


@dataclass(frozen=True)
class _Size:
    """The amount of simulation."""

    stable: tuple[int, int]
    """Trials and slots for each policy."""
    runs: int
    """Runs of `_RUN_SLOTS` slots for each policy of the unstable process."""
    run_trials: int
    """The trials that make up such a run."""


FULL, QUICK = _Size((2000, 1000), 100, 250), _Size((200, 100), 4, 500)


@final
class Luecke2022(Paper):
    """Coded states, and unencrypted states by a random or a threshold policy; numbers of the public program."""

    title = "Coding for Secrecy in Remote State Estimation With an Adversary"
    authors = "M. Lücke, J. Lu, D. E. Quevedo"
    published = (
        "IEEE Transactions on Automatic Control, 2022, doi 10.1109/TAC.2022.3169839; "
        "program: github.com/lueckem/remote_state_estimation"
    )

    def rows(self, quick: bool, progress: Progress) -> Iterator[PublishedNumber]:
        """The code's L, the errors for the stable process, and those for the unstable one."""
        size = QUICK if quick else FULL
        L = float(ReferenceCode(STABLE).at(1)[0, 0])
        yield PublishedNumber.compared("tutorial", "L for A = 0.9, Q = 1", 1.11111111, L, absolute=5e-9)
        for published in STABLE_NUMBERS:
            progress(f"A = 0.9, {published.policy}")
            trials, slots = size.stable
            means = mean_traces(STABLE, published.policy, (MU, *published.eavesdropper), trials, slots)
            yield from _estimated(published, means, trials * slots)
        for published in UNSTABLE_NUMBERS:
            progress(f"unstable A, {published.policy}")
            slots = _RUN_SLOTS // size.run_trials
            means = mean_traces(
                UNSTABLE, published.policy, (MU, *published.eavesdropper), size.runs * size.run_trials, slots, True
            )
            yield from _by_quantiles(published, means.reshape(2, size.runs, -1).mean(axis=2))
        reason = "neither the numbers nor the program of the optimal policy of the partially observed decision process are public"
        yield PublishedNumber.stated("examples", "the optimal policy", None, None, NumberVerdict.NOT_PUBLIC, reason)


def _estimated(printed: _Published, means: Floats, slots: int) -> Iterator[PublishedNumber]:
    """The rows of estimator and eavesdroppers; means: of each trial, (1 + eavesdroppers, R); slots: of all trials together."""
    mean, error = means.mean(axis=1), means.std(axis=1, ddof=1) / math.sqrt(means.shape[1])
    where = "random_policy/" if printed.policy.theta is None else "threshold_policy/"
    for i, ((mu_e, eavesdropper), legitimate) in enumerate(
        zip(printed.eavesdropper.items(), printed.legitimate, strict=True)
    ):
        for name, theirs, row in (("legitimate estimator", legitimate, 0), ("eavesdropper", eavesdropper, i + 1)):
            yield PublishedNumber.compared(
                where, f"{name}, {printed.policy}, μ_e = {mu_e}", theirs, float(mean[row]), float(error[row]),
                relative=0.02, errors=4.0, their_error=float(error[row]) * math.sqrt(slots / _THEIR_SLOTS),
            )  # fmt: skip


def _by_quantiles(printed: _Published, runs: Floats) -> Iterator[PublishedNumber]:
    """The rows of legitimate estimator and eavesdropper where no expectation is finite; runs: the mean of each run, (2, runs)."""
    ((mu_e, eavesdropper),) = printed.eavesdropper.items()
    for name, theirs, factor, means in (
        ("legitimate estimator", printed.legitimate[0], growth(printed.policy, MU), runs[0]),
        ("eavesdropper", eavesdropper, growth(printed.policy, mu_e, legitimate=False), runs[1]),
    ):
        low, middle, high = np.quantile(means, [0.05, 0.5, 0.95])
        reason = (
            f"the expectation has no bound: while the {name} lacks the reference, its expected error grows {factor:.3g}-fold "
            f"{'a slot' if printed.policy.theta is None else 'from one phase of unencrypted states to the next'}; the means of "
            f"runs of {_RUN_SLOTS:,} slots go from {low:.3g} to {high:.3g} (5 and 95 %), with the median {middle:.3g}"
        )
        verdict = NumberVerdict.NOT_COMPARABLE
        if name == "legitimate estimator":
            verdict = NumberVerdict.PROGRAM
            reason += "; they chose the policy so that this error is 2, but its mean settles nowhere"
        who = f"{name}, unstable A, {printed.policy}, μ_e = {mu_e}"
        yield PublishedNumber.stated("solve_optim.py", who, theirs, math.inf, verdict, reason)


def growth(policy: TransmissionPolicy, quality: float, legitimate: bool = True) -> float:
    """The growth of the expected error of a receiver that lacks the reference, for the unstable process.

    quality: of its link; legitimate: whether it is the one whose acknowledgements are flipped.
    """
    rates = rates_of("flip", MU, quality, flip=FLIP)
    reference = policy.scheme(UNSTABLE).lost_reference(quality, rates.legitimate if legitimate else rates.eavesdropper)
    assert reference is not None  # noqa: S101 - both schemes have references
    return reference.growth


def mean_traces(
    process: Process,
    policy: TransmissionPolicy,
    qualities: Sequence[float],
    trials: int,
    slots: int,
    open_loop: bool = False,
    side_by_side: int = _SIDE_BY_SIDE,
) -> Floats:
    """The mean of tr P over the slots of each trial, after a start that is left out: receivers × trials.

    The first receiver is the estimator. open_loop: L = A. Only covariances are followed, which do not depend on the states, so an
    unstable process has no horizon. side_by_side: trials that are simulated at once.
    """
    parts = [
        _batch_traces(
            process, policy, qualities, Batch(_START + slots, min(side_by_side, trials - first), first), open_loop
        )
        for first in range(0, trials, side_by_side)
    ]
    return np.concatenate(parts, axis=1)


def _batch_traces(
    process: Process, policy: TransmissionPolicy, qualities: Sequence[float], batch: Batch, open_loop: bool
) -> Floats:
    root = root_of_seed(2022)
    encoder = policy.encoder(ReferenceCode(process, open_loop), process.n, batch, stream_key(root, "schedule"))
    channel = AckChannel(
        AckChannelSpec(1.0, "flip", jammer=None, spans=None, flip=FLIP),
        stream_key(root, "link/acknowledgements"),
        batch,
    )
    links = [
        deliveries(
            link_of({"model": "bernoulli", "quality": quality}, stream_key(root, f"link/{i}"), batch), batch.slots
        )
        for i, quality in enumerate(qualities)
    ]
    receivers = [ReferenceReceiver(process, batch.trials, open_loop) for _ in qualities]
    beliefs = [receiver.prior() for receiver in receivers]
    nothing = np.zeros((process.n, batch.trials))
    total = np.zeros((len(receivers), batch.trials))
    for k, gammas in enumerate(zip(*links, strict=True)):
        header = encoder.encode(k, nothing, nothing).header
        for i, (receiver, gamma) in enumerate(zip(receivers, gammas, strict=True)):
            beliefs[i] = receiver.step(k, beliefs[i], Reception(gamma, nothing, header))
            if k >= _START:
                total[i] += np.trace(beliefs[i].P)
        encoder.acknowledged(k, channel.arrived(k, None, gammas[0], gammas[0]))
    return total / (batch.slots - _START)
