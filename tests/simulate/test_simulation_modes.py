"""Covariance-only and error coordinates against the ordinary mode and against theory.

Comparisons with theory are at 4.5 standard errors: a normal mean is beyond with a probability below 7e-6.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evedrop.cli.api import montecarlo
from evedrop.errors import ScenarioError, UsageError
from evedrop.model import streams
from evedrop.model.process import Process
from evedrop.model.receiver import Action
from evedrop.model.theory.covariances import Outcomes, theoretical_traces
from evedrop.results.reading import Results
from evedrop.scenario.loading import checked, load
from evedrop.scenario.receivers import LinkTable
from evedrop.scenario.stream_keys import StreamKeys
from evedrop.scenario.tables import Scenario
from evedrop.scenario.theory import expectations_of
from evedrop.score.scorekeeper import RunOutcome
from evedrop.simulate.montecarlo import Merger, Plan, check_mode
from evedrop.simulate.simulation import Mode, Simulation
from evedrop.simulate.trials import tasks_of
from tests.builders import MICROGRID, listener, process_table, scenario_of
from tests.conftest import Evedrop

SURE = 4.5
COVARIANCES, ERRORS = Plan(Mode.COVARIANCE_ONLY, workers=1), Plan(Mode.ERROR_COORDINATES, workers=1)
MARGINAL = [[1.0, 0.05], [0.0, 1.0]]
UNSTABLE = [[1.0, 0.3], [0.5, 1.001]]


def studied(A: list[list[float]], slots: int, mu_d: float = 0.6, **eavesdroppers: dict[str, Any]) -> Scenario:
    """A process with these receivers and a legitimate link of quality 0.9, allowed beyond the horizon."""
    identity = 1e-3 * np.eye(len(A))
    return scenario_of(
        Process(np.array(A), identity, identity),
        beyond_horizon=True,
        slots=slots,
        seed=5,
        trials=1_000_000,
        encoding={"scheme": "innovation", "state_probability": mu_d},
        eavesdroppers=eavesdroppers,
    )


def twin_tracks(**entries: Any) -> Scenario:
    """A marginally stable process of twin tracks behind a link of quality 0.5."""
    process = Process(np.array(MARGINAL), 1e-2 * np.eye(2), np.eye(2))
    table = {"encoding": {"scheme": "twin-track"}, "legitimate": {"link": {"quality": 0.5}}, **entries}
    return scenario_of(process, slots=12, seed=3, trials=4000, **table)


SMART = {"strategy": "smart", "link": {"quality": 0.85}}
NAIVE = {"strategy": "naive", "link": {"quality": 0.7}}
SUSPICIOUS = {"strategy": "suspicious", "use_state": 0.8, "use_innovation": 0.3, "link": {"quality": 0.9}}
ALL: dict[str, Any] = {"smart": SMART, "naive": NAIVE, "suspicious": SUSPICIOUS}


def quality_of(link: LinkTable | None) -> float:
    """The quality of a link whose losses are independent."""
    assert link is not None
    assert link.quality is not None
    return link.quality


def outcomes_of(of: Scenario) -> dict[str, Outcomes]:
    """Receiver → what it does with a slot, by the paper's definition of its strategy."""
    mu_d = of.encoding.mu_d
    outcomes = {"legitimate": Outcomes.legitimate(quality_of(of.legitimate.link), mu_d)}
    for name, table in of.eavesdroppers.items():
        uses = {"smart": (1.0, 0.0), "naive": (1.0, 1.0), "suspicious": (table.use_state, table.use_innovation)}
        use_state, use_innovation = uses[table.strategy]
        assert use_state is not None
        assert use_innovation is not None
        outcomes[name] = Outcomes.eavesdropper(quality_of(table.link), mu_d, use_state, use_innovation)
    return outcomes


Arrays = dict[str, dict[str, np.ndarray[Any, Any]]]


def played(of: Scenario, mode: Mode, trials: int, first: int = 0) -> Arrays:
    """Receiver → error, trace and action of every slot and trial."""
    parts: dict[str, dict[str, list[Any]]] = {name: {"error": [], "trace": [], "action": []} for name in of.receivers}
    for chunk in Simulation(of, range(first, first + trials), mode).chunks():
        for name, measured in chunk.receivers.items():
            for metric, arrays in parts[name].items():
                arrays.append(getattr(measured, metric).copy())
    return {
        name: {metric: np.concatenate(arrays) for metric, arrays in arrays_of.items()}
        for name, arrays_of in parts.items()
    }


def agrees(samples: np.ndarray[Any, Any], expected: np.ndarray[Any, Any]) -> None:
    """Means over trials (the last axis) are what is expected, at 4.5 standard errors."""
    spread = samples.std(axis=-1, ddof=1) / np.sqrt(samples.shape[-1])
    assert np.all(np.abs(samples.mean(axis=-1) - expected) <= SURE * spread + 1e-15)


@pytest.mark.parametrize("A", [MARGINAL, UNSTABLE], ids=["marginal", "unstable"])
def test_error_coordinates_are_the_ordinary_errors(A: list[list[float]]) -> None:
    """Same trials where both can run: same actions and beliefs, errors equal to rounding of the states they come from."""
    slots = 150 if A is MARGINAL else 26
    of = studied(A, slots, **ALL)
    exact, errors = played(of, Mode.EXACT, 60), played(of, Mode.ERROR_COORDINATES, 60)
    unread = Outcomes(predicted=1.0, state=0.0, misled=0.0, decoded=0.0, initial=1.0)
    state = np.sqrt(theoretical_traces(of.process.process, unread, slots))[:, None]
    for name in of.receivers:
        assert np.array_equal(exact[name]["action"], errors[name]["action"])
        assert np.array_equal(exact[name]["trace"], errors[name]["trace"])
        difference = np.abs(np.sqrt(exact[name]["error"]) - np.sqrt(errors[name]["error"]))
        assert np.all(difference <= 1e-11 * state)
        assert np.max(difference) <= 1e-9 * max(1.0, float(np.sqrt(exact[name]["error"]).max()))


def test_who_knows_the_start_has_no_error_from_it() -> None:
    """The legitimate estimator of twin tracks predicts from x_0 in every mode, also where it loses the first packets."""
    of = twin_tracks()
    exact, errors = played(of, Mode.EXACT, 60)["legitimate"], played(of, Mode.ERROR_COORDINATES, 60)["legitimate"]
    assert (exact["action"][0] == int(Action.LOST)).any()
    np.testing.assert_allclose(errors["error"], exact["error"], rtol=1e-9, atol=1e-20)


@pytest.mark.parametrize("kills", [[(3, 6)], [(0, 4), (6, 7)]])
def test_an_estimator_that_restarts_with_a_known_start_agrees_with_theory(kills: list[tuple[int, int]]) -> None:
    """Of twin tracks: while it is down nobody predicts from x_0, and afterwards it does so again."""
    of = twin_tracks(event=[{"from": start, "to": stop, "kill": "legitimate"} for start, stop in kills])
    error = played(of, Mode.EXACT, 4000)["legitimate"]["error"]
    agrees(error, expectations_of(of)["legitimate"].traces(of.slots))


@pytest.mark.parametrize("scheme", ["acknowledged", "open-loop"])
def test_no_theory_of_an_estimator_that_forgot_what_it_acknowledged(scheme: str) -> None:
    """After a restart from the prior it cannot read packets that refer to a state it had; with its last state it can."""
    for state in ("prior", "last"):
        of = twin_tracks(
            encoding={"scheme": scheme},
            acknowledgements={"link": {"quality": 0.9}},
            event=[{"from": 4, "to": 6, "kill": "legitimate", "state": state}],
        )
        error, theory = played(of, Mode.EXACT, 1000)["legitimate"]["error"], expectations_of(of)["legitimate"]
        plain = expectations_of(twin_tracks(encoding={"scheme": "plain"}, event=of.as_tables()["event"]))["legitimate"]
        assert theory.known == (state == "last")
        if theory.known:
            agrees(error, theory.traces(of.slots))
        assert (error[6:].mean() < 1.2 * plain.traces(of.slots)[6:].mean()) == theory.known


@pytest.mark.parametrize("scheme", ["acknowledged", "open-loop"])
@pytest.mark.parametrize(("start", "stop"), [(0, 4), (4, 12)])
def test_an_estimator_that_had_acknowledged_nothing_forgets_nothing(scheme: str, start: int, stop: int) -> None:
    """One that is down from slot 0 on had no state to forget; one that is down until the end of the run needs none."""
    of = twin_tracks(
        encoding={"scheme": scheme},
        acknowledgements={"link": {"quality": 0.9}},
        event=[{"from": start, "to": stop, "kill": "legitimate"}],
    )
    error, theory = played(of, Mode.EXACT, 1000)["legitimate"]["error"], expectations_of(of)["legitimate"]
    assert theory.known
    agrees(error, theory.traces(of.slots))


def test_covariances_alone_see_the_same_events() -> None:
    """Actions and reported covariances of the covariance-only mode are those of the ordinary one, to the bit."""
    of = studied(MARGINAL, 120, **ALL)
    exact, alone = played(of, Mode.EXACT, 40, 3), played(of, Mode.COVARIANCE_ONLY, 40, 3)
    for name in of.receivers:
        assert np.array_equal(exact[name]["action"], alone[name]["action"])
        assert np.array_equal(exact[name]["trace"], alone[name]["trace"])


@pytest.mark.parametrize("mode", [Mode.COVARIANCE_ONLY, Mode.ERROR_COORDINATES])
def test_which_streams_are_drawn(mode: Mode, monkeypatch: pytest.MonkeyPatch) -> None:
    """Covariance-only touches neither the process's nor the noise's stream; error coordinates need noise for the misled."""
    drawn: set[bytes] = set()

    class WatchedTally(streams.Stream):
        def __init__(self, key: bytes, trials: range, per_trial: int) -> None:
            super().__init__(key, trials, per_trial)
            self.key = key

        def whole_blocks(self, slots: range) -> streams.Words:
            drawn.add(self.key)
            return super().whole_blocks(slots)

    monkeypatch.setattr(streams, "Stream", WatchedTally)
    for receivers, misled in (({"smart": SMART}, False), (ALL, True)):
        of = studied(MARGINAL, 40, **receivers)
        drawn.clear()
        played(of, mode, 10)
        keys = StreamKeys.from_scenario(of)
        secret = keys.secret(("schedule", "noise"))
        assert secret["schedule"] in drawn
        assert all(keys.link(name, of.schedule(name))[f"link/{name}"] in drawn for name in of.receivers)
        assert (keys.process in drawn) == (mode is Mode.ERROR_COORDINATES)
        assert (secret["noise"] in drawn) == (mode is Mode.ERROR_COORDINATES and misled)


@pytest.mark.parametrize("mode", [Mode.COVARIANCE_ONLY, Mode.ERROR_COORDINATES])
def test_means_agree_with_theory(mode: Mode) -> None:
    """Every receiver's error and belief, at every tenth slot of a marginally stable process, over 4000 trials."""
    of = studied(MARGINAL, 111, mu_d=0.4, **ALL)
    result = played(of, mode, 4000)
    for name, outcomes in outcomes_of(of).items():
        for metric, theory in (("error", outcomes), ("trace", outcomes.reported)):
            expected = theoretical_traces(of.process.process, theory, of.slots)
            agrees(result[name][metric][::10], expected[::10])


def test_error_coordinates_go_where_states_cannot_be_followed() -> None:
    """An unstable process, 400 slots (state of 10⁵⁵), μ_d with finite variances: means at every twentieth slot."""
    of = studied([[1.2]], 400, mu_d=0.97, smart={"strategy": "smart", "link": {"quality": 0.9}})
    result = played(of, Mode.ERROR_COORDINATES, 4000)
    for name, outcomes in outcomes_of(of).items():
        agrees(result[name]["error"][::20], theoretical_traces(of.process.process, outcomes, of.slots)[::20])


def test_heavy_tails_agree_by_quantiles() -> None:
    """Where the mean is not a test: upper quantiles of |e|² in slot 300 of the paper's example, error coordinates against chains.

    The reference is independent: one long list of geometric times since the last state packet, each with its own
    covariance and a normal error. 6000 samples each, compared by the two-sample binomial bound at 4.5 σ.
    """
    of = studied(UNSTABLE, 301, mu_d=0.6)
    errors = played(of, Mode.ERROR_COORDINATES, 6000)["legitimate"]["error"][300]
    random = np.random.default_rng(3)
    A, Q, samples = np.array(UNSTABLE), 1e-3 * np.eye(2), []
    for _ in range(6000):
        since = min(int(random.geometric(0.9 * 0.6)) - 1, 300)  # slots since a state was received
        P = np.zeros((2, 2))
        lost = random.random(since) < 0.1 / (1 - 0.9 * 0.6)
        for lost_ in lost:
            P = A @ P @ A.T + (Q if lost_ else 0.0)
        error = np.linalg.cholesky(P) @ random.standard_normal(2) if lost.any() else np.zeros(2)
        samples.append(float(error @ error))
    synchronised = 0.54 / (1 - 0.9 * 0.4)
    assert abs((errors == 0.0).mean() - synchronised) < SURE * np.sqrt(synchronised * (1 - synchronised) / 6000)
    for level in (0.86, 0.9, 0.93, 0.96, 0.98):
        edge = np.quantile(samples, level)
        below = float((errors <= edge).mean())
        assert abs(below - level) < SURE * np.sqrt(2 * level * (1 - level) / 6000), level


@given(
    st.integers(1, 3), st.floats(0.9, 1.05), st.floats(0.2, 1.0), st.floats(0.0, 1.0), st.floats(0.2, 1.0),
    st.sampled_from(["smart", "naive", "suspicious"]), st.integers(0, 2**32),
)  # fmt: skip
@settings(deadline=None, max_examples=15, derandomize=True)
def test_random_scenarios_agree_with_theory(
    n: int, radius: float, mu: float, mu_e: float, mu_d: float, strategy: str, seed: int
) -> None:
    """Random A, Q, Σ0, links, μ_d and strategy, the real model with states and noise: squared errors meet theory.

    20 slots × 2 receivers at 5.5 standard errors plus a thousandth for skewed tails; 3000 trials; fixed seeds.
    """
    random = np.random.default_rng(seed)
    A = random.standard_normal((n, n)) + np.eye(n)
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    factors = [random.standard_normal((n, n)) for _ in range(2)]
    Q, start = (0.1 * (f @ f.T + 0.2 * np.eye(n)) for f in factors)
    extra = {"use_state": 0.7, "use_innovation": 0.4} if strategy == "suspicious" else {}
    tables = {
        "title": "random",
        "slots": 20,
        "seed": seed,
        "process": {"A": A.tolist(), "Q": (0.5 * (Q + Q.T)).tolist(), "initial_covariance": (0.5 * (start + start.T)).tolist()},
        "encoding": {"scheme": "innovation", "state_probability": mu_d},
        "legitimate": {"link": {"quality": mu}},
        "eavesdroppers": {"eve": {"strategy": strategy, "link": {"quality": mu_e}, **extra}},
    }  # fmt: skip
    of = checked(tables, "random")
    result = played(of, Mode.EXACT, 3000)
    for name, outcomes in outcomes_of(of).items():
        error = result[name]["error"]
        expected = theoretical_traces(of.process.process, outcomes, of.slots)
        spread = error.std(axis=1, ddof=1) / np.sqrt(3000)
        rare = 1e-3 * expected  # of an outcome that no trial may have had, the error is not sampled
        scarce = (error > 1e-20).sum(axis=1) < 60  # too few errors for a bound on their mean
        assert np.all((np.abs(error.mean(axis=1) - expected) <= 5.5 * spread + rare + 1e-12) | scarce), name


@pytest.mark.parametrize("plan", [COVARIANCES, ERRORS], ids=["covariance-only", "error-coordinates"])
def test_what_leaves_double_precision_is_refused(plan: Plan, tmp_path: Path) -> None:
    """A naive receiver's error overflows: one line with slot and remedy, nothing on disk; that many slots can be run."""
    changes: dict[str, Any] = {
        "slots": 4000,
        "eavesdroppers__naive__strategy": "naive",
        "eavesdroppers__naive__link__quality": 0.9,
    }
    with pytest.raises(
        UsageError, match=r"naive's expected error leaves double precision at slot (\d+); give \1 slots or fewer"
    ) as told:
        montecarlo("numerical", trials=2, plan=plan, out=tmp_path / "run", **changes)
    assert not (tmp_path / "run").exists()
    slots = int(str(told.value).partition("; give ")[2].split()[0])
    results = montecarlo("numerical", trials=2, plan=plan, out=tmp_path / "run", **{**changes, "slots": slots})
    assert results.summary["slots"] == slots
    with pytest.raises(ScenarioError, match="can be followed up to slot"):
        montecarlo("numerical", trials=2, out=tmp_path / "exact", **changes)


@pytest.mark.parametrize("plan", [COVARIANCES, ERRORS], ids=["covariance-only", "error-coordinates"])
@pytest.mark.parametrize("strategy", ["bayesian", "likelihood", "genie", "colluding", "replay-informed"])
def test_who_reads_packets_is_refused(plan: Plan, strategy: str, tmp_path: Path) -> None:
    """Named with strategy, reason and ways out; nothing on disk. What follows from losses alone is taken."""
    entries: dict[str, dict[str, Any]] = {
        "colluding": {"links": [{"quality": 0.5}, {"quality": 0.6}], "reads_as": "genie"},
        "replay-informed": {"link": {"quality": 0.5}, "reads_as": "smart", "learns_at": 3},
    }
    more = entries.get(strategy, {"link": {"quality": 0.5}})
    of = studied(MARGINAL, 20, eve={"strategy": strategy, **more}, smart=SMART)
    option = f'mode="{plan.mode.value}"'
    message = rf"{option} follows .* the actions of eve \(strategy {strategy}\).*; leave {option} out, or remove eve"
    with pytest.raises(UsageError, match=message):
        montecarlo(of, trials=2, plan=plan, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("name", "option"),
    [
        *((name, "--covariance-only") for name in ("acknowledged", "restart", "twin-track")),
        ("heated-room", "--error-coordinates"),
        *(
            pytest.param(name, "--covariance-only", marks=pytest.mark.long)
            for name in ("bayesian", "heated-room", "late")
        ),
        *(
            pytest.param(name, "--error-coordinates", marks=pytest.mark.long)
            for name in ("acknowledged", "bayesian", "late", "restart", "twin-track")
        ),
    ],
)
def test_a_refused_study_runs_as_advised(name: str, option: str, evedrop: Evedrop) -> None:
    """Every option that the message names is one of the command, and the command runs with each change that it advises."""
    command = ("montecarlo", name, "--trials", "2")
    refused = evedrop(*command, option, "--out", "refused")
    if (name, option) == ("heated-room", "--covariance-only"):
        assert refused.status in {0, 1}  # error-coordinates are refused with this advice
        return
    assert (refused.status, refused.out) == (2, "")
    options = set(re.findall(r"--[a-z-]+", refused.err))
    assert f"; leave {option} out" in refused.err
    assert options == ({option, "--covariance-only"} if name == "heated-room" else {option})
    for number, remedy in enumerate([[], *([single_option] for single_option in options - {option})]):
        done = evedrop(*command, *remedy, "--out", f"advised {number}")
        assert done.status in {0, 1}, done.err  # 1: two trials do not meet every expectation


def test_a_constant_one_and_a_pool_are_followed_in_every_mode() -> None:
    """Their actions follow from what was lost: the three modes agree on actions and beliefs, to the bit."""
    pool = {"strategy": "colluding", "links": [{"quality": 0.5}, {"quality": 0.6}], "reads_as": "smart"}
    of = studied(MARGINAL, 80, pool=pool, deaf={"strategy": "constant", "link": {"quality": 0.9}})
    exact, *others = (played(of, mode, 30) for mode in Mode)
    for name in of.receivers:
        for other in others:
            assert np.array_equal(exact[name]["action"], other[name]["action"])
            assert np.array_equal(exact[name]["trace"], other[name]["trace"])
    assert (exact["pool"]["action"] > 0).mean() == pytest.approx(0.8, abs=0.05)


@pytest.fixture(scope="module")
def covariances(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """A covariance-only run of several thousand slots."""
    out = tmp_path_factory.mktemp("modes") / "run"
    return montecarlo("eavesdroppers", trials=30, slots=5000, plan=COVARIANCES, out=out)


def test_results_say_what_was_simulated(covariances: Results) -> None:
    """No digest, no squared error, the actual trace in its own column, quantiles in every second of 5000 slots."""
    assert covariances.summary["mode"] == "covariance-only"
    for peer in covariances.summary["peers"].values():
        assert (peer["digest"], peer["mean_squared_error"]) == (None, None)
        assert peer["mean_actual_trace_covariance"] > 0.0
    (expectation,) = covariances.summary["expectations"]
    assert (expectation["held"], expectation["value"]) == (None, None)
    assert covariances.digests.num_rows == covariances.trials.num_rows == 0
    assert covariances.slots["mean_squared_error"].null_count == covariances.slots.num_rows
    assert covariances.slots["mean_actual_trace_covariance"].null_count == 0
    smart = [row for row in covariances.slots.to_pylist() if row["peer"] == "smart"]
    assert [row["slot"] for row in smart if row["error_quantile_0.5"] is not None] == list(range(0, 5000, 2))


def test_misled_receivers_report_less_than_there_is(covariances: Results) -> None:
    """Actual and reported trace differ for naive and suspicious, and are one for smart and legitimate."""
    for name, peer in covariances.summary["peers"].items():
        if name in {"naive", "suspicious"}:
            assert peer["mean_trace_covariance"] < 0.01 * peer["mean_actual_trace_covariance"]
        else:
            assert peer["mean_trace_covariance"] == peer["mean_actual_trace_covariance"]


def test_error_coordinates_have_no_digest(tmp_path: Path) -> None:
    """Squared errors agree with theory beyond the horizon of the ordinary mode; the horizon is not checked."""
    changes: dict[str, Any] = {"encoding__state_probability": 0.9, "slots": 300}
    results = montecarlo("numerical", trials=20, plan=ERRORS, out=tmp_path / "run", **changes)
    assert results.summary["mode"] == "error-coordinates"
    assert {peer["digest"] for peer in results.summary["peers"].values()} == {None}
    assert all(peer["mean_squared_error"] > 0.0 for peer in results.summary["peers"].values())
    assert load(results.folder, beyond_horizon=True).slots == 300


@pytest.mark.long
def test_the_table_of_the_microgrid(tmp_path: Path) -> None:
    """Day means of the trace, 1000 trials × 86 400 slots, μ_d 0.1, 0.5, 0.9: within 2 % of the known values."""
    of = checked(
        {
            "title": "microgrid",
            "slots": 86_400,
            "process": process_table(MICROGRID),
            "encoding": {"scheme": "innovation", "state_probability": 0.5},
            "legitimate": {"link": {"quality": 0.6}},
            "eavesdroppers": {"smart": {"strategy": "smart", "link": {"quality": 0.6}}},
        },
        "microgrid",
    )
    for mu_d, legitimate, smart in ((0.1, 1.333e-4, 3.133e-4), (0.5, 2.667e-5, 4.667e-5), (0.9, 1.481e-5, 1.704e-5)):
        plan = Plan(Mode.COVARIANCE_ONLY, workers=2)
        out = tmp_path / f"{mu_d}"
        peers = montecarlo(of, trials=1000, out=out, plan=plan, encoding__state_probability=mu_d).summary["peers"]
        assert peers["legitimate"]["mean_actual_trace_covariance"] == pytest.approx(legitimate, rel=0.02)
        assert peers["smart"]["mean_actual_trace_covariance"] == pytest.approx(smart, rel=0.02)


def test_a_mode_that_cannot_follow_a_long_run_names_the_slots_without_it() -> None:
    """Beyond the horizon, leaving the mode out is no way out by itself; before it, it is."""
    likelihood = {"strategy": "likelihood", "link": {"quality": 0.9}}
    for slots, beyond in ((2000, True), (20, False)):
        scenario = studied(UNSTABLE, slots, eve=likelihood)
        with pytest.raises(UsageError, match="leave --covariance-only out") as refused:
            check_mode(scenario, Mode.COVARIANCE_ONLY)
        assert (
            re.search(r"out and give at most [0-9,]+ slots, or remove eve", str(refused.value)) is not None
        ) == beyond


def test_squares_beyond_double_precision_are_infinite() -> None:
    """Without a warning, which fails a test; and so is a quantile between them."""
    scenario = scenario_of(
        Process(np.array([[1.5]]), np.eye(1), np.eye(1)),
        beyond_horizon=True,
        slots=875,
        trials=40,
        eavesdroppers={"deaf": listener("smart", 0.0)},
    )
    merger = Merger(scenario, Mode.ERROR_COORDINATES)
    for task in tasks_of(scenario, Mode.ERROR_COORDINATES, 1):
        merger.add_batch(task.carry_out(lambda _: None, lambda: False))
    quantiles = merger.summary(RunOutcome(1.0)).peers["deaf"].error_quantiles
    assert quantiles is not None
    assert quantiles["0.95"] == math.inf


def test_quantiles_of_a_process_without_noise_are_finite(tmp_path: Path) -> None:
    """Only the first covariance gives errors, and histograms have their scale from it."""
    process = {"A": [[1.0]], "Q": [[0.0]], "initial_covariance": [[1.0]], "singular_noise": True}
    results = montecarlo(
        "numerical", slots=4, trials=6, eavesdroppers={}, expect=[], process=process, out=tmp_path / "out",
        legitimate__link__quality=0.2, plan=Plan(Mode.COVARIANCE_ONLY),
    )  # fmt: skip
    values = results.slots["error_quantile_0.95"].to_numpy()
    assert (values > 0.0).any()
    assert not np.isinf(values).any()
