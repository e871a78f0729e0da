"""Rows of a wire's journal with the fates that real links give."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evedrop.model.slot.link import NEVER, Link, LinkSchedule, streams_of
from evedrop.model.streams import Batch, root_of_seed, stream_key
from evedrop.wire.plan import Side, WireLink, WirePlan
from evedrop.wire.records import RECORD, WireFate

START = 1_800_000_000.0
"""When the wires of these tests start, in seconds since 1970."""

BURSTS = {"model": "gilbert-elliott", "p": 0.03, "r": 0.2}
NORMAL = {"model": "normal", "mean": 0.02, "standard_deviation": 0.005}


def plan_of(*links: tuple[str, str, str, Mapping[str, Any]]) -> WirePlan:
    """A plan of links (name, source, target, settings) and their sides."""
    made = tuple(WireLink(name, i, a, b, "**", settings) for i, (name, a, b, settings) in enumerate(links))
    names = dict.fromkeys(side for link in made for side in (link.source, link.target))
    return WirePlan(7, {name: Side(name) for name in names}, made)


def robot_plan() -> WirePlan:
    """A robot, its base, and a listener that copies."""
    return plan_of(
        ("scan", "robot", "base", {"loss": BURSTS, "delay": NORMAL}),
        ("command", "base", "robot", {"loss": {"model": "bernoulli", "quality": 0.97}, "delay": NORMAL}),
        ("listener", "robot", "listener", {"loss": {"model": "bernoulli", "quality": 0.6}}),
    )


def rows_of(link: WireLink, seconds: float, rate: float, cut: tuple[float, float] = (0.0, 0.0)) -> NDArray[Any]:
    """Messages at a constant rate on a link, which is cut between two times."""
    count = round(seconds * rate)
    rows = np.zeros(count, RECORD)
    rows["n"], rows["time"] = np.arange(count), START + (np.arange(count) + 0.5) / rate
    schedule = LinkSchedule(link.settings, 2**32 - 1)
    keys = {name: stream_key(root_of_seed(7), name) for name in streams_of(link.name, schedule)}
    fates = Link(schedule, link.name, keys, Batch(NEVER, 1)).fates(range(count))
    rows["fate"], rows["link"], rows["sequence"], rows["size"], rows["key"] = fates.codes[:, 0], link.number, -1, 64, 1
    if fates.delays is not None and fates.rests is not None:
        rows["delay"] = fates.delays[:, 0] + fates.rests
    elapsed = rows["time"] - START
    rows["fate"][(elapsed >= cut[0]) & (elapsed < cut[1])] = WireFate.CUT
    return rows


def traffic(
    plan: WirePlan, seconds: float, rates: Mapping[str, float], cut: tuple[float, float] = (0.0, 0.0)
) -> NDArray[Any]:
    """Messages on all links with a rate, in order of time; links between robot and base are cut between two times."""
    pair = {"robot", "base"}
    parts = [
        rows_of(link, seconds, rates[link.name], cut if {link.source, link.target} == pair else (0.0, 0.0))
        for link in plan.links
        if link.name in rates
    ]
    rows = np.concatenate(parts)
    return rows[np.argsort(rows["time"], kind="stable")]
