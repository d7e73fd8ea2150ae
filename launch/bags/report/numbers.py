"""Compute all numbers of the bag report, for the HTML page and for `bag report --json`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from flexsheet.launch.bags.report.series import Maxima, Spread, States
from flexsheet.launch.bags.report.session import Arm, HostLoad, NodeSummary, Session
from flexsheet.launch.bags.report.strokes import FingerRun
from flexsheet.messages.busy import BUSY_REMEDY, describe_busy
from flexsheet.messages.methods import Methods
from flexsheet.messages.scene import Scene
from flexsheet.messages.topics import TOPICS

DEGREES = float(np.degrees(1.0))

METHODS = ("method", *Methods.model_fields)
"""The names of the node parameters that select a method."""


def compute_numbers(session: Session) -> dict[str, Any]:
    """Compute all numbers of the bag report.

    A number is None if the bag does not contain the data for it.
    """
    info, scene = session.info, session.scene
    return {
        "bag": {
            "path": str(info.path),
            "size_bytes": info.size_bytes,
            "complete": info.complete,
            "problem": info.problem,
            "duration_s": info.duration_s,
            "messages": info.count,
            "recording": session.metadata.get("recording", {}),
            "attachments": [one.name for one in info.attachments],
        },
        "git": session.git,
        "graph": _graph(session),
        "scene": None
        if scene is None
        else {
            "name": scene.name,
            "all": session.scenes,
            "shape": scene.object.geometry.shape,
            "camera": scene.camera.device,
            "tolerances": scene.tolerances.model_dump(),
            "max_edge_force_n": scene.sheet.max_edge_force_n,
            "max_tool_speed_m_per_s": scene.arms.max_tool_speed_m_per_s,
        },
        "hosts": {
            name: host.model_dump(exclude={"nodes", "host"}) | _load(session.loads[name])
            for name, host in session.hosts.items()
        },
        "topics": _topics(session),
        "latency_ms": {event: _spread_ms(spread) for event, spread in session.latencies.items()},
        "phases_s": _states(session.phases),
        "finger": {"states_s": _states(session.finger), "reasons": session.reasons},
        "arms": {
            side: _arm(arm, session.joint_speeds_rad_per_s(side))
            for side, arm in session.arms.items()
            if arm.modes.state
        },
        "sheet": {
            "contact": {
                "delta_d_mm": session.errors.contact["d"].summary(1e3),
                "delta_theta_deg": session.errors.contact["theta"].summary(DEGREES),
                "true_delta_d_mm": session.errors.contact["true_d"].summary(1e3),
                "true_delta_theta_deg": session.errors.contact["true_theta"].summary(DEGREES),
            },
            "strokes": [_stroke(session, one) for one in session.errors.runs if one.sums],
            "followed": [
                {"start_s": session.seconds(one.zero_ns), **one.figures()}
                for one in session.errors.runs
                if one.followed.exposures
            ],
            "push_mm": _most(session.push, 1e3),
        },
        "soft_body": {
            "methods": session.body_methods,
            "out_of_range": session.out_of_range,
            "force_n": _most(session.force, 1.0),
        },
        "frames": {
            "count": session.frames,
            "late": session.late_frames,
            "corrections": session.corrections,
            "draw_ms": _spread_ms(session.draw),
        },
        "nodes": {name: _node(session, name, one) for name, one in session.nodes.items()},
        "events": {
            "counts": session.events.counts,
            "first": [
                {"seconds": seconds, "kind": kind, "text": text}
                for seconds, kind, text in sorted(session.events.stored)
            ],
        },
        "images": {
            "stereo": session.stereo.count,
            "eye": session.eye.count,
            "frame": session.drawn.count,
        },
    }


def _load(load: HostLoad) -> dict[str, Any]:
    worst = load.worst
    return {
        "busy_fraction": load.busy / load.reports,
        "busy_at_worst": "" if worst is None else describe_busy(worst),
        "busy_remedy": "" if worst is None else BUSY_REMEDY,
    }


def _graph(session: Session) -> dict[str, Any] | None:
    plan = session.plan
    if plan is None:
        return None
    calibrations = {
        f"{node.name}.{key}": value
        for node in plan.nodes.values()
        for key, value in node.calibrations.items()
    }
    return {
        "launch_file": plan.launch_file,
        "scene_file": plan.scene_file,
        "hash": plan.hash,
        "hosts": plan.hosts,
        "calibrations": calibrations,
        "nodes": {
            node.name: {"type": node.type, "host": node.host, "parameters": node.parameters}
            for node in plan.nodes.values()
        },
    }


def _topics(session: Session) -> dict[str, Any]:
    found = {}
    recorded = {one.name: one for one in session.info.topics}
    for name in sorted({*recorded, *session.ports}):
        info, flow, port = recorded.get(name), session.flows.get(name), session.ports.get(name)
        topic = TOPICS.get(name)
        expected = None if topic is None or topic.many_writers else topic.rate_hz
        skipped, lost, refused = (None, None, None) if port is None else port.totals()
        found[name] = {
            "type": info.type if info else (topic.message.__name__ if topic else ""),
            "messages": info.count if info else 0,
            "recorded": info is not None,
            "readable": info.readable if info else None,
            "rate_hz": info.rate_hz if info else None,
            "expected_hz": expected,
            "age_ms": None if flow is None else _spread_ms(flow.age),
            "readers_age_ms": None if port is None else _spread_ms(port.age),
            "silences": flow.silences if flow else 0,
            "longest_silence_s": flow.longest_silence_s if flow else None,
            "missing": flow.lost if flow else 0,
            "skipped": skipped,
            "lost": lost,
            "refused": refused,
        }
    return found


def _arm(arm: Arm, limits_rad_per_s: Sequence[float]) -> dict[str, Any]:
    peaks = [one.overall() for one in arm.joint_speed]
    return {
        "modes_s": _states(arm.modes),
        "joint_speed_ratio": [
            None if peak is None else peak / limit
            for peak, limit in zip(peaks, limits_rad_per_s, strict=True)
        ],
        "tool_speed_mm_per_s": _most(arm.tool_speed, 1e3),
        "edge_force_n": _most(arm.edge_force, 1.0),
        "cycle_ms": _spread_ms(arm.cycle),
    }


def _stroke(session: Session, stroke: FingerRun) -> dict[str, Any]:
    scales = {"delta_d": ("mm", 1e3), "delta_theta": ("deg", DEGREES)}
    row: dict[str, Any] = {
        "seconds": stroke.stroke_s,
        "start_s": session.seconds(stroke.stroke_window_ns[0]),
    }
    for name, (unit, scale) in scales.items():
        for prefix in ("", "true_"):
            sums = stroke.sums.get(prefix + name)
            row[f"{prefix}{name}_{unit}"] = None if sums is None else sums.summary(scale)
    return row


def _node(session: Session, name: str, summary: NodeSummary) -> dict[str, Any]:
    planned = None if session.plan is None else session.plan.nodes.get(name)
    cpu = summary.cpu.summary(1.0)
    return {
        "method": None if planned is None else describe_methods(planned.parameters, session.scene),
        "cpu_mean": None if cpu is None else cpu["mean"],
        "cpu_max": None if cpu is None else cpu["max"],
        "resident_mb": 1e-6 * summary.resident_bytes,
        "starts": summary.starts,
        "degraded": summary.degraded,
        "errors": summary.errors,
        "last_error": summary.last_error,
        "note": summary.note,
    }


def describe_methods(parameters: Mapping[str, Any], scene: Scene | None) -> str | None:
    """Return a text with the methods that a node uses.

    Return None if the node has no parameter that selects a method. The parameter value "auto"
    selects the method in the scene.
    """
    by_scene = scene.methods.model_dump() if scene is not None else {}
    by_scene["method"] = (by_scene.get("soft_body") or {}).get("method")
    found = []
    for name in METHODS:
        value = parameters.get(name)
        if value == "auto":
            value = by_scene.get(name) or "default"
        if isinstance(value, str):
            found.append(value if name == "method" else f"{name} {value}")
    return ", ".join(found) or None


def _states(states: States) -> dict[str, float]:
    return {name: seconds for name, seconds in states.seconds.items() if seconds > 0.0}


def _spread_ms(spread: Spread) -> dict[str, float | int | None]:
    found = {"p50": spread.quantile_s(0.5), "p99": spread.quantile_s(0.99)}
    longest = spread.longest_s if spread.count else None
    scaled = {key: None if value is None else 1e3 * value for key, value in found.items()}
    return {**scaled, "max": None if longest is None else 1e3 * longest, "count": spread.count}


def _most(range_: Maxima, scale: float) -> float | None:
    overall = range_.overall()
    return None if overall is None else scale * overall
