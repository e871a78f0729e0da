"""Nothing waits without a limit: every call of `wait`, `join`, `get`, `result` or `recv` says how long, but for a few."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
WORK = "a daemon thread that waits for its next work; nobody waits for the thread without a limit"
PROCESS = "a process of a run: SIGTERM ends it at once, and so do the recorder, the launcher's end and a lost router"
END = "a daemon thread that waits for the end of a process; nobody waits for the thread"
VIRTUAL = "a simulation in which everybody waits ends with `Stuck`"
EXCEPTIONS = {
    "emulator/evedrop/virtual/zenoh/handlers.py items_of channel.recv": VIRTUAL,
    "emulator/evedrop/virtual/zenoh/session.py recv self.handler.recv": VIRTUAL,
    "emulator/evedrop/virtual/zenoh/session.py _receive self.inbox.get": VIRTUAL,
    "emulator/evedrop/virtual/processes.py _serve self._requests.get": VIRTUAL,
    "emulator/evedrop/virtual/processes.py _report process.wait": VIRTUAL,
    "emulator/evedrop/virtual/other_hosts.py serve program.wait": VIRTUAL,
    "emulator/evedrop/virtual/scheduler.py wait self._lock.acquire": VIRTUAL,
    "emulator/evedrop/virtual/scheduler.py __enter__ self.acquire": VIRTUAL,
    "emulator/evedrop/virtual/scheduler.py __enter__ self._lock.acquire": VIRTUAL,
    "emulator/evedrop/fork_server.py serve select.select": (
        "the end of its channel wakes it, and the launcher's end closes the channel"
    ),
    "emulator/evedrop/live/launch/children.py _follow process.wait": END,
    "emulator/evedrop/live/launch/children.py _confirm_end process.wait": END,
    "emulator/evedrop/live/launch/other_hosts.py _follow process.wait": END,
    "emulator/evedrop/live/network/connection.py _keep_open self._losses.get": WORK,
    "emulator/evedrop/live/network/connection.py take self.recv": PROCESS,
    "emulator/evedrop/live/network/connection.py _received self._subscribers.get": PROCESS,
    "emulator/evedrop/live/network/connection.py _received self._subscriber.recv": PROCESS,
    "emulator/evedrop/live/network/connection.py __iter__ self.recv": PROCESS,
    "emulator/evedrop/live/network/process_session.py take self._subscription.recv": PROCESS,
    "emulator/evedrop/live/network/router.py _go_round self._changed.wait": WORK,
    "emulator/evedrop/live/network/router.py _acknowledged self.sent.get": PROCESS,
    "emulator/evedrop/live/network/router.py next self._orders.get": PROCESS,
    "emulator/evedrop/live/network/session.py _send_again self._rounds.get": WORK,
    "emulator/evedrop/live/network/session.py command self._commands.get": PROCESS,
    "emulator/evedrop/live/protocol/commands.py go_on self._requests.get": WORK,
    "emulator/evedrop/simulate/cluster.py _result future.result": "the future is done",
    "emulator/evedrop/simulate/workers.py _talk self._tasks.get": WORK,
    "emulator/evedrop/simulate/workers.py _talk self.pipe.recv": (
        "the end of its worker closes the pipe, and a suspended worker is killed"
    ),
    "emulator/evedrop/simulate/workers.py work pipe.recv": "the end of the study closes the pipe",
    "emulator/evedrop/studies/scenario_tests.py results future.result": "the future is done",
    "emulator/evedrop/studies/scenario_tests.py carry_out process.wait": "the process has closed its output, or is killed",
    "emulator/evedrop/wire/send_queue.py _wait self._bell.acquire": WORK,
    "emulator/evedrop/wire/queries.py _run self._heard.get": WORK,
    "peers/sensor.py wait self._mailbox.get": PROCESS,
}
"""File, function and call → why it needs no limit."""
CONTEXT = {"TAKEN", "_NO_MODULES", "_OF_COMMAND", "_OF_JSON", "_OF_RUN"}
"""Variables of a context, whose `get` does not wait."""


def waits_for_ever(call: ast.Call) -> bool:
    """Whether a call waits without a limit, as far as its text says."""
    if not isinstance(call.func, ast.Attribute):
        return False
    limits = {word.arg: word.value for word in call.keywords}
    limit = limits.get("timeout", call.args[0] if len(call.args) == 1 else None)
    match call.func.attr:
        case "wait" | "join" | "result" | "recv" | "acquire" | "get":
            of_text = isinstance(call.func.value, ast.Constant)  # " ".join(words)
            return not of_text and "blocking" not in limits and ((not call.args and not limits) or _may_be_none(limit))
        case "communicate":
            return limits.get("timeout") is None
        case "run" | "call" | "check_call" | "check_output":
            return ast.unparse(call.func.value) == "subprocess" and limits.get("timeout") is None
        case "select":
            return ast.unparse(call.func.value) == "select" and len(call.args) < 4
    return False


def _may_be_none(limit: ast.expr | None) -> bool:
    """Whether a limit is None, at least sometimes."""
    branches = [limit.body, limit.orelse] if isinstance(limit, ast.IfExp) else [limit]
    return any(isinstance(branch, ast.Constant) and branch.value is None for branch in branches)


def waits(path: Path) -> Iterator[str]:
    """The calls in a file that wait without a limit, as in `EXCEPTIONS`."""

    def visit(node: ast.AST, function: str) -> Iterator[str]:
        if isinstance(node, ast.FunctionDef):
            function = node.name
        if isinstance(node, ast.Call) and waits_for_ever(node):
            called = ast.unparse(node.func)
            if called.partition(".")[0] not in CONTEXT:
                yield f"{path.relative_to(ROOT)} {function} {called}"
        for child in ast.iter_child_nodes(node):
            yield from visit(child, function)

    yield from visit(ast.parse(path.read_text("utf-8")), "")


def test_nothing_waits_without_a_limit() -> None:
    """Except the listed waits, each with its reason; and the list has no entry that is gone from the code."""
    present = {
        wait for folder in ("emulator", "peers") for path in (ROOT / folder).rglob("*.py") for wait in waits(path)
    }
    assert present - {*EXCEPTIONS} == set(), "give a limit, or say in EXCEPTIONS why none is needed"
    assert {*EXCEPTIONS} - present == set(), "remove these from EXCEPTIONS"


@pytest.mark.parametrize(
    ("text", "forever"),
    [
        ("thread.join()", True),
        ("thread.join(None)", True),
        ("thread.join(2.0)", False),
        ("event.wait(timeout=None)", True),
        ("event.wait(seconds)", False),
        ("event.wait(1.0 if due else None)", True),
        ("queue.get()", True),
        ("table.get(name)", False),
        ("table.get(name, None)", False),
        ("' and '.join(None)", False),
        ("lock.acquire(blocking=False)", False),
        ("process.communicate(text)", True),
        ("process.communicate(timeout=5)", False),
        ("subprocess.run(command)", True),
        ("context.run(command)", False),
        ("select.select(a, b, [])", True),
        ("select.select(a, b, [], 1.0)", False),
        ("np.select(a, b)", False),
    ],
)
def test_what_counts_as_a_wait_without_a_limit(text: str, forever: bool) -> None:
    """Calls as they stand in programs."""
    call = ast.parse(text, mode="eval").body
    assert isinstance(call, ast.Call)
    assert waits_for_ever(call) is forever
