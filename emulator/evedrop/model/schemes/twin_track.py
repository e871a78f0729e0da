"""Twin track: the state, or the state that the process would have had from another, equally likely start."""

from __future__ import annotations

from collections.abc import Mapping
from typing import final

import numpy as np

from evedrop.model.kernels.elementary import cholesky
from evedrop.model.packet_user import StateReader
from evedrop.model.process import Floats, Process, product
from evedrop.model.receiver import Belief, Flags, Reception, select
from evedrop.model.schemes.scheme import Encoder, NoInnovations, Packet, Scheme, Shared
from evedrop.model.streams import Ahead, Batch, BlockReader, Recurrence
from evedrop.model.theory.closed_forms import twin_track_bound
from evedrop.model.theory.covariances import Outcomes

_SOON, _LATE, _GROWN = 2**10, 2**30, 1e3  # powers of A: bounded if the later one is not larger by this factor


@final
class TwinTracks:
    """x_0 and y_0 ~ N(0, Σ0) from the stream `start`, their distance d_k = A^k (y_0 − x_0), and the coins from `track`.

    Asking for slots in order is quick; any other order is correct.
    """

    def __init__(self, process: Process, keys: Mapping[str, bytes], batch: Batch) -> None:
        normals = BlockReader(keys["start"], batch, 2 * process.n).normals(range(1))[0]
        factor = cholesky(process.initial_covariance)
        self.initial: Floats = product(factor, normals[: process.n])
        """x_0, (n, R)."""
        self._distance = Recurrence(product(factor, normals[process.n :]) - self.initial, process.predict)
        reader = BlockReader(keys["track"], batch, 1)
        self._coins = Ahead(reader.ahead, lambda slots: reader.uniforms(slots)[:, 0, :] < 0.5)

    def distance(self, k: int) -> Floats:
        """d_k, (n, R): the distance from the process's track to its twin's."""
        return self._distance.at(k)

    def on_twin(self, k: int) -> Flags:
        """Whether the packet of slot k is on the twin's track, (R,), by a fair coin."""
        return self._coins.at(k)


class TwinTrackEncoder(Encoder):
    """z_k = x_k, or x_k + d_k, in slot 0 as well."""

    def __init__(self, tracks: TwinTracks) -> None:
        self._tracks = tracks

    def encode(self, k: int, x: Floats, predicted: Floats) -> Packet:  # noqa: ARG002 - the state alone is sent
        """The packet of slot k."""
        z = select(self._tracks.on_twin(k), lambda: x + self._tracks.distance(k), lambda: x)
        return Packet(z, np.zeros(x.shape[1], np.bool_))


class TwinTrackEstimator(StateReader):
    """Knows x_0 before the first packet, and the track of every packet."""

    def __init__(self, process: Process, trials: int, tracks: TwinTracks) -> None:
        super().__init__(process, trials)
        self._tracks = tracks

    def prior(self, first: int = 0) -> Belief:
        """x̂ = x_0, P = 0, predicted up to the slot before `first`."""
        n = self.process.n
        x_hat, P = self._tracks.initial, np.zeros((n, n, self.trials))
        for _ in range(first - 1):
            x_hat, P = self.process.predict(x_hat), self.process.diffuse(self.process.carry(P))
        return Belief(x_hat, P, np.zeros(self.trials, np.uint8))

    def read(self, k: int, heard: Reception) -> Floats:
        """The packet itself, or z − d_k where it is on the twin's track."""
        return select(self._tracks.on_twin(k), lambda: heard.z - self._tracks.distance(k), lambda: heard.z)


class TwinTrack(Scheme):
    """Two tracks; only with the secret can a receiver tell which of them is the process's own.

    x_0 is part of the secret, so the process must start from `initial_state`. Strategies that know the schedule of states and
    innovations do not apply to it, and no strategy has the key of `track` or `start`.

    Source: docs/mathematics/schemes.md, twin track.
    """

    sent_words = ("track",)
    best_reader = "tracker"
    secret_streams = ("start", "track")
    estimator_streams = ("start", "track")
    secret_words = (1, 0)
    initial_secret_words = (0, 2)

    def shared(self, keys: Mapping[str, bytes], batch: Batch) -> Shared:
        """The two starts and the coins."""
        tracks = TwinTracks(self.process, keys, batch)
        return NoInnovations(
            self.process,
            batch.trials,
            lambda: TwinTrackEncoder(tracks),
            lambda: TwinTrackEstimator(self.process, batch.trials, tracks),
        )

    def initial_state(self, keys: Mapping[str, bytes], batch: Batch) -> Floats:
        """x_0, (n, R), by the stream `start`."""
        return TwinTracks(self.process, keys, batch).initial

    def error_floor(self, slots: int) -> tuple[Floats, bool]:
        """Half the error of a receiver that knows nothing of x_0, (slots,); it grows with the powers of A.

        Source: docs/mathematics/schemes.md, twin track.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            soon, late = (np.abs(np.linalg.matrix_power(self.process.A, power)).max() for power in (_SOON, _LATE))
        return twin_track_bound(self.process, slots), bool(not (np.isfinite(soon) and late <= _GROWN * soon))

    def outcomes(self, mu: float) -> Outcomes:
        """A state with every packet, and x_0 without any."""
        return Outcomes(predicted=1.0 - mu, state=mu, misled=0.0, decoded=0.0, initial=0.0)
