"""A legitimate estimator written from docs/protocol.md and the pages it names: nothing of this project is imported, nor numpy.

`python independent_legitimate.py BRIEF` takes part in a run; `Estimator` can be driven with recorded messages.
"""

from __future__ import annotations

import json
import math
import struct
import sys
import time
from collections.abc import Iterable, Sequence
from hashlib import sha256
from typing import Any

import msgpack
from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes
from xxhash import xxh3_128

Matrix = list[list[float]]
Belief = tuple[list[float], Matrix]

A_ = (3.3871328727963666080e0, 1.3314166789178437745e2, 1.9715909503065514427e3, 1.3731693765509461125e4,
      4.5921953931549871457e4, 6.7265770927008700853e4, 3.3430575583588128105e4, 2.5090809287301226727e3)  # fmt: skip
B_ = (1.0, 4.2313330701600911252e1, 6.8718700749205790830e2, 5.3941960214247511077e3,
      2.1213794301586595867e4, 3.9307895800092710610e4, 2.8729085735721942674e4, 5.2264952788528545610e3)  # fmt: skip
C_ = (1.42343711074968357734e0, 4.63033784615654529590e0, 5.76949722146069140550e0, 3.64784832476320460504e0,
      1.27045825245236838258e0, 2.41780725177450611770e-1, 2.27238449892691845833e-2, 7.74545014278341407640e-4)  # fmt: skip
D_ = (1.0, 2.05319162663775882187e0, 1.67638483018380384940e0, 6.89767334985100004550e-1,
      1.48103976427480074590e-1, 1.51986665636164571966e-2, 5.47593808499534494600e-4, 1.05075007164441684324e-9)  # fmt: skip
E_ = (6.65790464350110377720e0, 5.46378491116411436990e0, 1.78482653991729133580e0, 2.96560571828504891230e-1,
      2.65321895265761230930e-2, 1.24266094738807843860e-3, 2.71155556874348757815e-5, 2.01033439929228813265e-7)  # fmt: skip
F_ = (1.0, 5.99832206555887937690e-1, 1.36929880922735805310e-1, 1.48753612908506148525e-2,
      7.86869131145613259100e-4, 1.84631831751005468180e-5, 1.42151175831644588870e-7, 2.04426310338993978564e-15)  # fmt: skip


def poly(coefficients: Sequence[float], x: float) -> float:
    """Horner's rule, from the highest power down."""
    v = coefficients[-1]
    for c in coefficients[-2::-1]:
        v = v * x + c
    return v


def log(x: float) -> float:
    """The logarithm of the protocol's section on arithmetic."""
    m, p = math.frexp(x)
    if m < 0.7071067811865476:
        m, p = 2 * m, p - 1
    f = m - 1
    s = f / (2 + f)
    z = s * s
    w = z * z
    even = poly((3.999999999940941908e-01, 2.222219843214978396e-01, 1.531383769920937332e-01), w)
    odd = poly(
        (6.666666666666735130e-01, 2.857142874366239149e-01, 1.818357216161805012e-01, 1.479819860511658591e-01), w
    )
    t = w * even + z * odd
    h = (0.5 * f) * f
    return p * 6.93147180369123816490e-01 - ((h - (s * (h + t) + p * 1.90821492927058770002e-10)) - f)


def quantile(u: float) -> float:
    """Wichura's AS 241."""
    q = u - 0.5
    r = 0.180625 - q * q
    if r >= 0:
        return (poly(A_, r) / poly(B_, r)) * q
    s = math.sqrt(-log(u if u <= 0.5 else 1 - u))
    size = poly(C_, s - 1.6) / poly(D_, s - 1.6) if s <= 5 else poly(E_, s - 5) / poly(F_, s - 5)
    return size if u > 0.5 else -size


def words(key: bytes, slot: int, trial: int, m: int) -> tuple[int, ...]:
    """The m words of a stream for one slot and trial."""
    b = (m + 1) // 2
    encryptor = Cipher(algorithms.AES(key), modes.ECB()).encryptor()  # noqa: S305 - the protocol's counter mode
    counters = b"".join(((slot << 64) + trial * b + i).to_bytes(16, "big") for i in range(b))
    return struct.unpack(f"<{2 * b}Q", encryptor.update(counters))[:m]


def uniform(word: int) -> float:
    """A uniform of a word."""
    return (word >> 11) * 2.0**-53


def normal(word: int) -> float:
    """A normal of a word."""
    return quantile(((word >> 12) + 0.5) * 2.0**-52)


def dot(pairs: Iterable[tuple[float, float]]) -> float:
    """A sum in order: it starts with its first product."""
    total, *products = [a * b for a, b in pairs]
    for product in products:
        total += product
    return total


def times(M: Matrix, N: Matrix) -> Matrix:
    """A product of matrices."""
    columns = list(zip(*N, strict=True))
    return [[dot(zip(row, column, strict=True)) for column in columns] for row in M]


def carried(M: Matrix, P: Matrix) -> Matrix:
    """M P Mᵀ."""
    B = times(M, P)
    return [[dot(zip(left, right, strict=True)) for right in M] for left in B]


def cholesky(M: Matrix) -> Matrix:
    """The lower Cholesky factor."""
    n = len(M)
    L = [[0.0] * n for _ in M]
    for i in range(n):
        for j in range(i + 1):
            s = M[i][j]
            for c in range(j):
                s -= L[i][c] * L[j][c]
            L[i][j] = math.sqrt(s) if i == j else s / L[j][j]
    return L


def triangular(W: Matrix) -> Matrix:
    """The triangular factor by rotations."""
    n, m = len(W), len(W[0])
    for i in range(n):
        for j in range(i + 1, m):
            a, b = W[i][i], W[i][j]
            if b == 0:
                continue
            r = math.sqrt(a * a + b * b)
            c, s = a / r, b / r
            W[i][i], W[i][j] = r, 0.0
            for row in W[i + 1 :]:
                u, v = row[i], row[j]
                row[i], row[j] = c * u + s * v, c * v - s * u
        if W[i][i] < 0:
            for row in W[i:]:
                row[i] = -row[i]
    return [row[:n] for row in W]


class Estimator:
    """One receiver of the scheme `innovation`, all trials of its brief."""

    def __init__(self, brief: dict[str, Any]) -> None:
        model = brief["model"]
        self.A, self.Q = model["A"], model["Q"]
        self.n, self.R, self.first = len(self.A), brief["trials"], brief["first_trial"]
        self.mu_d, self.slots, self.recorded = model["state_probability"], brief["slots"], brief["recorded"]
        self.keys = {name: bytes.fromhex(key) for name, key in brief["keys"].items()}
        self.G = cholesky(self.Q)
        self.L = cholesky(model["initial_covariance"])
        self.due = 0
        self.belief: list[Belief] = [([0.0] * self.n, model["initial_covariance"]) for _ in range(self.R)]
        self.hashes = [xxh3_128() for _ in range(self.R)]
        self.blocks: dict[int, bytes] = {}
        self.sums, self.block_sums = [0.0] * self.R, dict[int, bytes]()
        self.rows: list[tuple[int, list[list[float]], list[int], list[Matrix]]] = []

    def receive(self, payload: bytes) -> None:
        """A recorded delivery: step all trials."""
        self.take(msgpack.unpackb(payload))

    def take(self, message: dict[str, Any]) -> None:
        """A delivery: step all trials, slot by slot."""
        if message["k"] != self.due:
            raise ValueError(f"slot {message['k']} arrived, slot {self.due} was due")
        mask_bytes, z = (self.R + 7) // 8, message.get("z", b"")
        if len(message["gamma"]) != mask_bytes * message["c"]:
            raise ValueError(f"gamma of {len(message['gamma'])} bytes for {message['c']} slots")
        for row in range(message["c"]):
            mask = message["gamma"][row * mask_bytes : (row + 1) * mask_bytes]
            got = [(mask[r // 8] >> (r % 8)) & 1 for r in range(self.R)]
            size = 8 * self.n * sum(got)
            self.pass_slot(got, struct.unpack(f"<{size // 8}d", z[:size]))
            z = z[size:]
        if z:
            raise ValueError(f"{len(z)} bytes of z for nobody")

    def pass_slot(self, got: list[int], z: tuple[float, ...]) -> None:
        """The next slot: which trials received, and their payloads."""
        k, heard = self.due, sum(got)
        self.due += 1
        noise_factor: Matrix = []
        if k > 0:
            noise_factor = times(self.A, self.L)
            self.L = triangular([left + right for left, right in zip(noise_factor, self.G, strict=True)])
        actions, place = [], 0
        for r in range(self.R):
            packet = None
            if got[r]:
                packet = [z[i * heard + place] for i in range(self.n)]
                place += 1
            self.belief[r], action = self.step(k, r, packet, noise_factor)
            actions.append(action)
            x, P = self.belief[r]
            self.hashes[r].update(bytes([got[r]]))
            self.hashes[r].update(struct.pack(f"<{self.n}d", *x))
            for i, row in enumerate(P):
                self.hashes[r].update(struct.pack(f"<{self.n - i}d", *row[i:]))
            self.sums[r] += sum(P[i][i] for i in range(self.n))
        if k % 256 == 255 or k == self.slots - 1:
            self.blocks[k - k % 256] = b"".join(hash_.digest() for hash_ in self.hashes)
            self.hashes = [xxh3_128() for _ in range(self.R)]
            self.block_sums[k - k % 256] = struct.pack(f"<{self.R}d", *self.sums)
            self.sums = [0.0] * self.R
        self.rows.append((k, [x for x, _ in self.belief], actions, [P for _, P in self.belief]))

    def step(self, k: int, r: int, z: list[float] | None, noise_factor: Matrix) -> tuple[Belief, int]:
        """One trial, one slot: the belief after it, and the action."""
        x, P = self.belief[r]
        trial = self.first + r
        innovation, chi, C, D = False, [0.0] * self.n, P, P
        if k > 0:
            innovation = uniform(words(self.keys["schedule"], k, trial, 1)[0]) >= self.mu_d
            xi = [normal(word) for word in words(self.keys["noise"], k, trial, self.n)]
            chi = [dot(zip(row, xi, strict=True)) for row in noise_factor]
            x = [dot(zip(row, x, strict=True)) for row in self.A]
            C = carried(self.A, P)
            D = [[c + q for c, q in zip(*rows, strict=True)] for rows in zip(C, self.Q, strict=True)]
        if z is None:
            return (x, D), 0
        if not innovation:
            return (z, [[0.0] * self.n for _ in range(self.n)]), 1
        return ([a + (b - c) for a, b, c in zip(x, z, chi, strict=True)], C), 2

    def digest(self) -> str:
        """The digest of the whole run."""
        whole = sha256()
        for r in range(self.R):
            for block in sorted(self.blocks):
                whole.update(self.blocks[block][16 * r : 16 * r + 16])
        return whole.hexdigest()

    def report(self) -> bytes:
        """The report of all slots since the last one."""
        rows, self.rows = self.rows, []
        flat, traces = [], []
        for _, xs, _, _ in rows:
            flat += [x[i] for i in range(self.n) for x in xs]
        covariances = []
        for _, _, _, Ps in rows:
            covariances += [P[i][j] for i in range(self.n) for j in range(self.n) for P in Ps[: self.recorded]]
            tr = [sum(P[i][i] for i in range(self.n)) for P in Ps]
            traces += [sum(tr), sum(t * t for t in tr)]
        message = {
            "k": rows[0][0],
            "c": len(rows),
            "x_hat": struct.pack(f"<{len(flat)}d", *flat),
            "action": bytes(a for _, _, actions, _ in rows for a in actions),
            "P": struct.pack(f"<{len(covariances)}d", *covariances),
            "trace": struct.pack(f"<{len(traces)}d", *traces),
            "digests": {b: d for b, d in self.blocks.items() if b + 255 >= rows[0][0]},
        }
        ended = {b: s for b, s in self.block_sums.items() if b + 255 >= rows[0][0]}
        if ended and self.recorded < self.R:
            message["trace_sums"] = ended
        packed: bytes = msgpack.packb(message)
        return packed


def take_part(brief: dict[str, Any]) -> str:
    """Follow a run to its end."""
    import zenoh

    config = {
        "mode": "client",
        "connect": {"endpoints": [brief["router"]], "timeout_ms": -1},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"auth": {"usrpwd": {"user": brief["user"], "password": brief["password"]}}},
    }
    name, under = brief["process"], f"evedrop/{brief['run']}/"
    estimator, batch = Estimator(brief), brief["flow"]["batch"]
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
        commands = session.declare_subscriber(under + f"control/{name}", zenoh.handlers.FifoChannel(16))
        deliveries = session.declare_subscriber(under + f"downlink/{name}", zenoh.handlers.FifoChannel(65536))
        block = zenoh.CongestionControl.BLOCK
        telemetry = session.declare_publisher(under + f"telemetry/{name}", congestion_control=block)
        progress = session.declare_publisher(under + f"progress/{name}", congestion_control=block)

        def put(publisher: zenoh.Publisher, message: bytes) -> None:
            publisher.put(msgpack.packb(str(publisher.key_expr)) + message)

        def is_read(publisher: zenoh.Publisher) -> bool:
            return bool(publisher.matching_status.matching)  # type: ignore[attr-defined]  # the stub says bool

        def received(subscriber: zenoh.Subscriber[Any]) -> Any:
            """The next message on a subscriber's key; what names another key is dropped."""
            while True:
                unpacker = msgpack.Unpacker()
                unpacker.feed(subscriber.recv().payload.to_bytes())
                if unpacker.unpack() == str(subscriber.key_expr):
                    return unpacker.unpack()

        while not (is_read(telemetry) and is_read(progress)):
            time.sleep(0.005)
        token = session.liveliness().declare_token(under + f"alive/{name}")
        while estimator.due < brief["slots"]:  # a message ends where a report ends, or before
            estimator.take(received(deliveries))
            done = estimator.due
            ends = done % batch == 0 or done == brief["slots"]
            if ends or done % 256 == 0:
                put(telemetry, estimator.report())
            if ends:
                put(progress, msgpack.packb({"k": done}))
        while received(commands)["do"] != "end":
            pass
        put(telemetry, msgpack.packb({"over": True}))
        del token
    return estimator.digest()


if __name__ == "__main__":
    with open(sys.argv[1]) as file:
        print(take_part(json.load(file)))  # noqa: T201 - its only output
