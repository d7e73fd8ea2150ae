"""Draw the charts of the bag report as SVG, with descriptions, for light and dark pages."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flexsheet.launch.bags.report.series import Grid, Spread, States
from flexsheet.launch.bags.report.session import Session
from flexsheet.launch.experiments.stroke import ARM_EVENTS, LatencyEvent
from flexsheet.launch.methods.svg import COLOURS, INK, page_style, render_svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


WIDTH_IN = 9.0
GOOD, MIDDLE, DOUBTFUL, BAD = "#7fa99b", "#0072b2", "#e69f00", "#c0392b"
STATE_COLOURS = {
    "wait": "#9aa5ad", "approach": "#56b4e9", "contact": MIDDLE, "hold": DOUBTFUL,
    "starting": "#9aa5ad", "idle": "#9aa5ad", "follow": MIDDLE, "relax": DOUBTFUL,
    "disconnected": BAD,
    "stopping": BAD, "fault": BAD, "estop": BAD,
    "tracking": MIDDLE, "acquiring": "#56b4e9", "coasting": DOUBTFUL, "lost": BAD,
    "released": "#9aa5ad", "engaged": BAD,
}  # fmt: skip
HATCHES = {"hold": "//", "coasting": "//", "relax": "//", "fault": "xx", "estop": "xx",
           "engaged": "xx", "lost": "xx", "disconnected": "..", "stopping": ".."}  # fmt: skip
"""The hatch pattern that represents each state for readers who cannot distinguish the colours."""

MARKS = {"bookmark": ("v", GOOD), "gap": ("|", DOUBTFUL), "restart": ("s", BAD),
         "error": ("x", BAD), "fault": ("X", BAD), "estop": ("D", BAD)}  # fmt: skip
EVENTS = (
    LatencyEvent.FINGERTIP,
    LatencyEvent.SHEET_TARGET,
    *ARM_EVENTS.values(),
    LatencyEvent.SOFT_BODY,
    LatencyEvent.FRAME_DRAWN,
)


@dataclass(frozen=True, slots=True)
class Chart:
    """A chart of the report.

    svg: image of the chart.
    text: description of the image for readers who cannot see it.
    caption: explanation below the chart.
    """

    svg: str
    text: str
    caption: str


def draw_charts(session: Session) -> dict[str, Chart]:
    """Draw all charts for which the bag contains data. The keys of the result are chart names."""
    makers: dict[str, Callable[[Session], Chart | None]] = {
        "timeline": timeline,
        "latency": latencies,
        "path": paths,
        "errors": sheet_errors,
        "joints": draw_joint_speeds,
        "force": forces,
    }
    found = {}
    with page_style():
        for name, make in makers.items():
            chart = make(session)
            if chart is not None:
                found[name] = chart
    return found


def _figure(rows: int, columns: int, height_in: float) -> tuple[Figure, NDArray[np.object_]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def _over_time(axes: Axes, session: Session) -> None:
    """Limit the time axis to the duration of the bag, and add a grid.

    The lines of the chart must be drawn before this call.
    """
    mark_isolated(axes)
    axes.set_xlim(0.0, session.info.duration_s)
    axes.grid(visible=True, alpha=0.2)


def mark_isolated(axes: Axes) -> None:
    """Draw a dot at each value between two NaN values, because a line does not show it."""
    for line in axes.lines:
        known = np.isfinite(np.asarray(line.get_ydata(), dtype=float))
        has_neighbour = np.zeros_like(known)
        has_neighbour[1:] |= known[:-1]
        has_neighbour[:-1] |= known[1:]
        isolated = np.flatnonzero(known & ~has_neighbour).tolist()
        if isolated and line.get_marker() == "None":
            line.set_marker(".")
            line.set_markevery(isolated)


def timeline(session: Session) -> Chart | None:
    """Draw the states of sheet, arms and finger tracker over time as coloured bars, with events.

    Return None if the bag contains no states and no events.
    """
    strips = [
        (name, states)
        for name, states in (
            ("sheet", session.phases),
            ("left arm", session.arms["left"].modes),
            ("right arm", session.arms["right"].modes),
            ("finger", session.finger),
            ("e-stop", session.estop),
        )
        if states.state is not None
    ]
    kinds = [kind for kind in MARKS if kind in session.events.counts]
    if not strips and not kinds:
        return None
    from matplotlib.patches import Patch

    rows = len(strips) + bool(kinds)
    figure, grid = _figure(1, 1, 0.5 * rows + 1.5)
    axes: Axes = grid[0][0]
    axes.set_axisbelow(True)
    styles: dict[tuple[str, str | None], list[str]] = {}
    for row, (name, states) in enumerate(strips):
        lasting = name == "e-stop"
        for state, begin_s, end_s in find_intervals(states, session.fine, lasting=lasting):
            colour, hatch = style = STATE_COLOURS.get(state, MIDDLE), HATCHES.get(state)
            axes.barh(
                row, end_s - begin_s, left=begin_s, height=0.7, color=colour, hatch=hatch,
                edgecolor="#ffffff" if hatch else colour, linewidth=0.0,
            )  # fmt: skip
            texts = styles.setdefault(style, [])
            if state not in texts:
                texts.append(state)
    for kind in kinds:
        marker, colour = MARKS[kind]
        at = [seconds for seconds, _ in session.events.select(kind)]
        axes.plot(at, [len(strips)] * len(at), marker, color=colour, label=kind, markersize=8)
    names = [name for name, _ in strips] + (["events"] if kinds else [])
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    _over_time(axes, session)
    axes.set_xlabel("time in the bag, s")
    patches = [
        Patch(facecolor=colour, hatch=hatch, edgecolor="#ffffff", label=", ".join(texts))
        for (colour, hatch), texts in styles.items()
    ]
    handles, _ = axes.get_legend_handles_labels()
    figure.legend(handles=[*patches, *handles], ncols=5, fontsize=8, loc="outside lower center")
    spent = [
        f"{name}: "
        + ", ".join(f"{state} {seconds:.1f} s" for state, seconds in sort_by_duration(states))
        for name, states in strips
    ]
    counts = [f"{session.events.counts[kind]} × {kind}" for kind in kinds]
    return Chart(
        render_svg(figure),
        "Timeline. " + "; ".join([*spent, *counts]) + ".",
        "States of the sheet, the arms and the finger's tracker; white: nothing was recorded. The "
        "most severe state of each interval is drawn.",
    )


def sort_by_duration(states: States) -> list[tuple[str, float]]:
    """Return (state, total duration in s) for each state, with the longest duration first.

    States of less than 0.05 s are omitted.
    """
    lasted = [(state, seconds) for state, seconds in states.seconds.items() if seconds > 0.05]
    return sorted(lasted, key=lambda one: -one[1])


def find_intervals(
    states: States, grid: Grid, *, lasting: bool = False
) -> Iterator[tuple[str, float, float]]:
    """Yield each interval of constant state as (state, start in s, end in s).

    lasting: whether a state continues until the next state, even if no messages arrive.
    """
    width_s = grid.duration_s / grid.count
    # Bridge short gaps, which occur if messages are rarer than intervals of the grid.
    max_gap = max(int(0.5 / width_s), 1)
    codes = states.codes.tolist()
    begin, code, last = 0, States.NOTHING, -1
    for i, one in enumerate([*codes, States.NOTHING]):
        if one == States.NOTHING:
            if code != States.NOTHING and (i == len(codes) or (i - last > max_gap and not lasting)):
                end = len(codes) if lasting else last + 1
                yield states.names[code], begin * width_s, end * width_s
                code = States.NOTHING
            continue
        if one != code:
            if code != States.NOTHING:
                yield states.names[code], begin * width_s, i * width_s
            begin, code = i, one
        last = i


def latencies(session: Session) -> Chart | None:
    """Draw the latency from exposure to each event against time, as median and 99 % quantile.

    Return None if the bag contains no latencies.
    """
    events = [event for event in EVENTS if event in session.latencies]
    if not events:
        return None
    rows = (len(events) + 1) // 2
    figure, grid = _figure(rows, 2, 1.9 * rows + 0.4)
    seconds = session.grid.seconds()
    texts = []
    for i, event in enumerate(events):
        axes: Axes = grid[i // 2][i % 2]
        spread: Spread = session.latencies[event]
        p50, p99 = 1e3 * spread.quantiles_s(0.5), 1e3 * spread.quantiles_s(0.99)
        axes.plot(seconds, p99, "-", linewidth=0.9, color=COLOURS[4], label="99 %")
        axes.plot(seconds, p50, "-", linewidth=1.4, color=COLOURS[0], label="median")
        if session.scene is not None and event in ARM_EVENTS.values():
            allowed_ms = 1e3 * session.scene.tolerances.latency_s
            axes.axhline(allowed_ms, linestyle="--", color=INK, linewidth=1.0, label="tolerance")
        axes.set_ylim(0.0, 1.15 * float(np.nanquantile(p99, 0.98)))
        axes.set_title(event, fontsize=10)
        _over_time(axes, session)
        axes.set_ylabel("ms")
        whole = [spread.quantile_s(fraction) or 0.0 for fraction in (0.5, 0.99)]
        texts.append(f"{event} {1e3 * whole[0]:.1f} and {1e3 * whole[1]:.1f} ms")
    grid[0][0].legend(fontsize=8)
    for axes in grid[-1]:
        axes.set_xlabel("time in the bag, s")
    for i in range(len(events), grid.size):
        grid[i // 2][i % 2].set_visible(False)
    return Chart(
        render_svg(figure),
        "Latency from the exposure to each step over the whole bag, median and 99 %: "
        + "; ".join(texts)
        + ".",
        "Time from the centre of the exposure until the message or the arm command is sent, or "
        "the frame is drawn.",
    )


def paths(session: Session) -> Chart | None:
    """Draw the paths of the finger and of the sheet's centre, from the front and from the side.

    Return None if the bag contains no positions.
    """
    finger, true = 1e3 * session.finger_path.points, 1e3 * session.true_path.points
    sheet = 1e3 * session.sheet_path.points
    known = [points for points in (finger, true, sheet) if np.isfinite(points).any()]
    if not known:
        return None
    figure, grid = _figure(1, 2, 4.2)
    views = (("from the front", 0, "x (right), mm"), ("from the side", 2, "z (to the user), mm"))
    for axes, (title, across, label) in zip(grid[0], views, strict=True):
        for points, name, style, colour in (
            (sheet, "planned sheet centre", "-", COLOURS[4]),
            (true, "true finger", "-", COLOURS[2]),
            (finger, "measured finger", ".", COLOURS[0]),
        ):
            shown = points[np.isfinite(points[:, 0])]
            if len(shown):
                axes.plot(
                    shown[:, across], shown[:, 1], style, color=colour, label=name,
                    linewidth=1.0, markersize=2.5,
                )  # fmt: skip
        axes.set_title(title, fontsize=10)
        axes.set_xlabel(label)
        axes.set_ylabel("y (up), mm")
        axes.set_aspect("equal", adjustable="datalim")
        axes.grid(visible=True, alpha=0.2)
    grid[0][0].legend(fontsize=8)
    all_points = np.concatenate(known)
    low, high = np.nanmin(all_points, axis=0), np.nanmax(all_points, axis=0)
    spans = ", ".join(
        f"{axis} from {a:.0f} to {b:.0f} mm" for axis, a, b in zip("xyz", low, high, strict=True)
    )
    return Chart(
        render_svg(figure),
        f"Paths of finger and sheet in the world frame: {spans}.",
        "Positions in the world frame, whose origin is the centre of the virtual screen.",
    )


def sheet_errors(session: Session) -> Chart | None:
    """Draw the maximum position and angle errors of the sheet during contact, against time.

    Return None if the bag contains no errors.
    """
    errors = session.errors
    shown = [
        (name, label)
        for name, label in (("true", "true finger"), ("measured", "measured finger"))
        if errors.distance[name].overall() is not None
    ]
    if not shown:
        return None
    figure, grid = _figure(2, 1, 4.2)
    seconds = session.grid.seconds()
    for axes, values, scale, label in (
        (grid[0][0], errors.distance, 1e3, "Δd, mm"),
        (grid[1][0], errors.angle, float(np.degrees(1.0)), "Δθ, degrees"),
    ):
        for i, (name, texts) in enumerate(shown):
            axes.plot(
                seconds, scale * values[name].maximum, color=COLOURS[4 * i], linewidth=1.0,
                linestyle=("-", "--")[i], label=f"against the {texts}",
            )  # fmt: skip
        axes.set_ylabel(label)
        axes.set_ylim(bottom=0.0)
        _over_time(axes, session)
    if session.scene is not None:
        allowed_mm = 1e3 * session.scene.tolerances.sheet_position_m
        grid[0][0].axhline(allowed_mm, linestyle="--", color=INK, linewidth=1.0, label="tolerance")
    grid[0][0].legend(fontsize=8)
    grid[1][0].set_xlabel("time in the bag, s")
    worst = [
        f"against the {label} {1e3 * overall:.2f} mm"
        for name, label in shown
        if (overall := errors.distance[name].overall()) is not None
    ]
    return Chart(
        render_svg(figure),
        "Errors of the sheet in contact, as defined by Furukawa et al. 2007; maximum: "
        + ", ".join(worst)
        + ".",
        f"Maximum of each {session.grid.duration_s / session.grid.count:.2g} s in contact. The "
        "commanded depth of the sheet below the surface is not an error.",
    )


def draw_joint_speeds(session: Session) -> Chart | None:
    """Draw the maximum speed of each joint against time, as a percentage of its speed limit.

    Return None if the bag contains no joint speeds.
    """
    arms = {
        side: arm for side, arm in session.arms.items() if arm.joint_speed[0].overall() is not None
    }
    if not arms:
        return None
    figure, grid = _figure(len(arms), 1, 2.3 * len(arms) + 0.3)
    seconds = session.grid.seconds()
    texts = []
    for axes, (side, arm) in zip(grid[:, 0], arms.items(), strict=True):
        for i, (range_, limit) in enumerate(
            zip(arm.joint_speed, session.joint_speeds_rad_per_s(side), strict=True)
        ):
            percent = 100.0 * range_.maximum / limit
            axes.plot(seconds, percent, linewidth=1.0, color=COLOURS[i], label=f"J{i + 1}")
        axes.axhline(100.0, linestyle="--", color=INK, linewidth=1.0, label="limit")
        axes.set_title(f"{side} arm", fontsize=10)
        axes.set_ylabel("% of the limit")
        axes.set_ylim(bottom=0.0)
        _over_time(axes, session)
        percents = [
            100.0 * overall / limit
            for range_, limit in zip(
                arm.joint_speed, session.joint_speeds_rad_per_s(side), strict=True
            )
            if (overall := range_.overall()) is not None
        ]
        texts.append(f"{side} arm at most {max(percents):.0f} %")
    grid[0][0].legend(fontsize=8, ncols=7, loc="upper right")
    grid[-1][0].set_xlabel("time in the bag, s")
    return Chart(
        render_svg(figure),
        f"Joint speeds in percent of their limits: {', '.join(texts)}.",
        "Maximum of each interval; speeds are averages of the measured joint angles over 25 ms.",
    )


def forces(session: Session) -> Chart | None:
    """Draw the sheet's edge forces, the object's force and the push depth against time.

    Return None if the bag contains no edge forces.
    """
    arms = {side: arm for side, arm in session.arms.items() if arm.edge_force.overall() is not None}
    if not arms:
        return None
    figure, grid = _figure(2, 1, 4.4)
    seconds = session.grid.seconds()
    upper, lower = grid[0][0], grid[1][0]
    texts = []
    for i, (side, arm) in enumerate(arms.items()):
        upper.plot(seconds, arm.edge_force.maximum, color=COLOURS[4 * i], linewidth=1.2,
                   linestyle=("-", "--")[i], label=f"{side} edge")  # fmt: skip
        overall = arm.edge_force.overall()
        texts.append(f"{side} edge at most {overall:.1f} N")
    if session.scene is not None:
        most_n = session.scene.sheet.max_edge_force_n
        upper.axhline(most_n, linestyle="--", color=INK, linewidth=1.0, label="limit")
    upper.set_ylabel("edge force, N")
    lower.plot(seconds, 1e3 * session.push.maximum, color=COLOURS[2], label="push, mm")
    lower.plot(seconds, session.force.maximum, color=COLOURS[4], linestyle="--", label="force, N")
    lower.set_ylabel("push, mm; force, N")
    for axes in (upper, lower):
        # Leave space for the legend above the lines.
        axes.set_ylim(0.0, 1.3 * axes.get_ylim()[1])
        axes.legend(fontsize=8, ncols=3, loc="upper right")
        _over_time(axes, session)
    lower.set_xlabel("time in the bag, s")
    return Chart(
        render_svg(figure),
        f"Forces: {', '.join(texts)}.",
        "Top: forces at the sheet's edges, reported by the arm bridges. Bottom: push depth of the "
        "finger, and the object's force on it, computed by the soft-body solver.",
    )
