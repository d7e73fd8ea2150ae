"""Create the bag report as one self-contained HTML file for screen and print."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from flexsheet.launch.bags.report.album import Album, Shot
from flexsheet.launch.bags.report.charts import Chart, draw_charts
from flexsheet.launch.bags.report.findings import CHECKED, SessionFinding, find_problems
from flexsheet.launch.bags.report.numbers import compute_numbers
from flexsheet.launch.bags.report.session import Session

MARK = "<!-- made by: flexsheet bag report -->"
"""The comment by which a report is recognized.

A file that does not contain this comment is not overwritten by a report.
"""

COLOURS = {
    "light": {"ground": "#ffffff", "text": "#1f2328", "quiet": "#57606a", "line": "#d0d7de",
              "link": "#0550ae", "bad": "#b91c1c", "doubtful": "#8a4b00", "good": "#166534",
              "panel": "#f6f8fa"},
    "dark": {"ground": "#0d1117", "text": "#e6edf3", "quiet": "#9da7b1", "line": "#30363d",
             "link": "#79c0ff", "bad": "#ff9a92", "doubtful": "#e3b341", "good": "#7ee787",
             "panel": "#161b22"},
}  # fmt: skip

SECTIONS = {
    "findings": "Problems",
    "bag": "Recording",
    "timeline": "Timeline",
    "topics": "Topics",
    "latency": "Latency",
    "sheet": "Finger and sheet",
    "arms": "Arms",
    "nodes": "Nodes and methods",
    "images": "Images",
}

EVENTS_SHOWN = 60
BRIEF_S = 0.02
"""The minimum duration (s) of a state that the page lists.

The chart and the output of --json contain all states.
"""

_CSS = """
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 70rem; padding: 1rem 1.25rem 4rem; background: var(--ground);
  color: var(--text); font: 16px/1.5 system-ui, sans-serif; }
a { color: var(--link); }
a:focus-visible, summary:focus-visible, [tabindex]:focus-visible {
  outline: 3px solid var(--link); outline-offset: 2px; }
.skip { position: absolute; left: -100rem; }
.skip:focus { left: 1rem; background: var(--ground); padding: .25rem .5rem; }
h1 { font-size: 1.6rem; margin: .5rem 0 0; overflow-wrap: anywhere; }
h2 { font-size: 1.25rem; margin: 2.2rem 0 .5rem; border-bottom: 1px solid var(--line); }
h3 { font-size: 1.05rem; margin: 1.4rem 0 .4rem; }
nav ul { list-style: none; padding: 0; margin: .75rem 0; display: flex; flex-wrap: wrap;
  gap: .25rem 1rem; }
.quiet, figcaption, caption { color: var(--quiet); }
.bad { color: var(--bad); font-weight: 600; }
.doubtful { color: var(--doubtful); font-weight: 600; }
.good { color: var(--good); font-weight: 600; }
.findings li { margin: .3rem 0; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .875rem; font-variant-numeric: tabular-nums;
  margin: .5rem 0; }
caption { text-align: left; padding: .25rem 0; }
th, td { text-align: left; vertical-align: top; padding: .2rem .9rem .2rem 0;
  border-top: 1px solid var(--line); }
td.number, th.number { text-align: right; }
tbody th { font-weight: 600; }
figure { margin: 1rem 0; break-inside: avoid; }
figure img { width: 100%; height: auto; }
figcaption { font-size: .875rem; }
.shots { display: flex; flex-wrap: wrap; gap: 1rem; }
.shots figure { margin: 0; width: 32rem; max-width: 100%; background: var(--panel);
  padding: .5rem; }
.shots .pair { display: flex; gap: .5rem; }
.shots img { flex: 1 1 0; min-width: 0; }
code, pre { font-family: ui-monospace, monospace; font-size: .85rem; overflow-wrap: anywhere; }
pre { background: var(--panel); padding: .75rem; overflow-x: auto; }
@media print {
  body { max-width: none; font-size: 11pt; padding: 0; } nav, .skip { display: none; }
  h2 { break-after: avoid; } table { font-size: 8.5pt; } tr { break-inside: avoid; }
  .scroll { overflow: visible; }
}
"""


def render_page(session: Session) -> str:
    """Return the report of a recorded session as HTML text."""
    numbers, charts = compute_numbers(session), draw_charts(session)
    name = Path(numbers["bag"]["path"]).name
    body = [
        '<a class="skip" href="#findings">Skip to the problems</a>',
        f"<header><h1>{escape(name)}</h1>",
        f'<p class="quiet">{_subtitle(numbers)}</p></header>',
        '<nav aria-label="Sections"><ul>',
        *(f'<li><a href="#{key}">{title}</a></li>' for key, title in SECTIONS.items()),
        "</ul></nav><main>",
        *_section("findings", _findings(find_problems(numbers))),
        *_section("bag", _bag(numbers)),
        *_section("timeline", _timeline(numbers, charts)),
        *_section("topics", _topics(numbers)),
        *_section("latency", _latency(numbers, charts)),
        *_section("sheet", _sheet(numbers, charts)),
        *_section("arms", _arms(numbers, charts)),
        *_section("nodes", _nodes(numbers)),
        *_section("images", _images(session, numbers)),
        "</main>",
    ]
    head = (
        '<!doctype html>\n<html lang="en">\n'
        f'{MARK}\n<head><meta charset="utf-8"><title>{escape(name)}: report of a session</title>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<style>{_variables()}{_CSS}</style></head>\n<body>\n"
    )
    return head + "\n".join(body) + "\n</body></html>\n"


def _variables() -> str:
    def root(scheme: str) -> str:
        lines = "".join(f"--{name}: {value}; " for name, value in COLOURS[scheme].items())
        return f":root {{ {lines}}}"

    dark = f"@media screen and (prefers-color-scheme: dark) {{ {root('dark')} }}"
    return f"{root('light')}\n{dark}"


def _section(key: str, content: Iterable[str]) -> Iterator[str]:
    yield f'<section aria-labelledby="{key}"><h2 id="{key}">{SECTIONS[key]}</h2>'
    yield from content
    yield "</section>"


def _subtitle(numbers: Mapping[str, Any]) -> str:
    bag, scene = numbers["bag"], numbers["scene"]
    parts = [
        bag["recording"].get("started", "recorded at an unknown time")[:19].replace("T", " "),
        duration(bag["duration_s"]),
        f"{bag['messages']} messages",
        f"{bag['size_bytes'] / 1e6:.1f} MB",
        *([f"scene {scene['name']}"] if scene else []),
    ]
    return escape(" · ".join(parts))


def _findings(findings: Sequence[SessionFinding]) -> Iterator[str]:
    if not findings:
        yield '<p class="good">✓ No problem was found.</p>'
    else:
        marks = {"bad": "✕ Failure:", "doubtful": "▲ Check:"}
        yield '<ul class="findings">'
        for one in findings:
            yield (
                f'<li><span class="{one.gravity}">{marks[one.gravity]}</span> {escape(one.text)} '
                f'<a href="#{one.section}">{SECTIONS[one.section]}</a></li>'
            )
        yield "</ul>"
    yield f'<p class="quiet">Checked: {CHECKED}.</p>'


def _bag(numbers: Mapping[str, Any]) -> Iterator[str]:
    bag, git, graph, scene = (numbers[key] for key in ("bag", "git", "graph", "scene"))
    code = git.get("commit")
    rows = [
        ("File", bag["path"]),
        ("Complete", "yes" if bag["complete"] else f"no: {bag['problem']}"),
        ("Started", bag["recording"].get("started", "unknown")),
        ("Clock", bag["recording"].get("clock_id", "unknown")),
        ("Code", "unknown" if code is None else code + (", changed" if git.get("changed") else "")),
    ]
    if graph is None:
        yield _missing("The plan of the graph (plan.json) is not in the bag.")
    else:
        rows += [
            ("Launch file", graph["launch_file"]),
            ("Scene file", graph["scene_file"] or "none"),
            ("Plan", graph["hash"]),
            ("Hosts", ", ".join(f"{name} ({at})" for name, at in graph["hosts"].items())),
            ("Calibrations", "; ".join(f"{k}: {v}" for k, v in graph["calibrations"].items())
             or "none: the nodes use the scene's optics and geometry"),
        ]  # fmt: skip
    if scene is None:
        yield _missing("No scene was recorded, so the tolerances cannot be checked.")
    else:
        rows += [
            ("Scenes", ", ".join(scene["all"])),
            ("Object", scene["shape"]),
            ("Camera", scene["camera"]),
        ]
    yield table("The recording", ("property", "value"), rows)
    if numbers["hosts"]:
        yield table(
            "Computers at the end of the recording",
            ("host", "busy, % of the time", "code", "Python", "load per core", "free disk, GB",
             "missing devices"),
            [
                (name, 100.0 * one["busy_fraction"], one["code"], one["python"],
                 one["load_ratio"], one["disk_free_bytes"] / 1e9,
                 ", ".join(one["missing_devices"]) or "none")
                for name, one in numbers["hosts"].items()
            ],
        )  # fmt: skip
    yield "<h3>Further commands</h3>"
    path = escape(bag["path"])
    yield (
        f"<pre>flexsheet bag info {path}\nflexsheet bag verify {path} planner\n"
        f"flexsheet bag export {path} -o for-foxglove.mcap</pre>"
    )


def _timeline(numbers: Mapping[str, Any], charts: Mapping[str, Chart]) -> Iterator[str]:
    yield figure(charts.get("timeline"), "No arm, finger or sheet was recorded.")
    rows = [
        (what, ", ".join(f"{state} {duration(s)}" for state, s in spent.items() if s > BRIEF_S))
        for what, spent in (
            ("sheet", numbers["phases_s"]),
            *((f"{side} arm", arm["modes_s"]) for side, arm in numbers["arms"].items()),
            ("finger", numbers["finger"]["states_s"]),
        )
        if spent
    ]
    if rows:
        yield table("Time in each state", ("part", "state and time"), rows)
    events, counts = numbers["events"]["first"], numbers["events"]["counts"]
    if not events:
        yield "<p>No scene, bookmark, gap, fault, restart or e-stop was recorded.</p>"
        return
    texts = ", ".join(f"{count} × {kind}" for kind, count in counts.items())
    title = f"Events ({texts})"
    if len(events) > EVENTS_SHOWN:
        title += f"; only the first {EVENTS_SHOWN} are shown, and --json contains all"
    event_rows = [(one["seconds"], one["kind"], one["text"]) for one in events[:EVENTS_SHOWN]]
    yield table(title, ("time, s", "kind", "event"), event_rows)


def _topics(numbers: Mapping[str, Any]) -> Iterator[str]:
    rows = []
    for name, one in numbers["topics"].items():
        expected = one["expected_hz"]
        # The age of messages that are published only once has no meaning.
        flows = expected is not None or (one["rate_hz"] or 0.0) > 1.0
        rows.append(
            (
                name,
                one["messages"] if one["recorded"] else "not recorded",
                one["rate_hz"] if flows else None,
                None if expected is None else f"{expected[0]:g} to {expected[1]:g}",
                _lookup(one["readers_age_ms"] or one["age_ms"], "p50") if flows else None,
                _lookup(one["readers_age_ms"] or one["age_ms"], "p99") if flows else None,
                one["longest_silence_s"] if expected else None,
                one["skipped"],
                one["lost"],
                one["missing"],
                one["refused"],
            )
        )
    yield table(
        "Age: time from the source timestamp until the message is read, or recorded if there is no "
        "other reader. Skipped: intentionally replaced by a newer message before it was read, or "
        "dropped from the queue of a topic with the delivery latest. Lost: on the way from writer "
        "to readers. Missing: not in the bag. Refused: invalid.",
        ("topic", "messages", "Hz", "expected, Hz", "age, ms", "age 99 %, ms",
         "maximum gap, s", "skipped", "lost", "missing", "refused"),
        rows,
    )  # fmt: skip
    if not any(name == "status" and one["messages"] for name, one in numbers["topics"].items()):
        yield _missing("The topic status was not recorded, so the readers are unknown.")


def _latency(numbers: Mapping[str, Any], charts: Mapping[str, Chart]) -> Iterator[str]:
    yield figure(charts.get("latency"), "No topic with a latency was recorded.")
    rows = [
        (event, one["p50"], one["p99"], one["max"], one["count"])
        for event, one in numbers["latency_ms"].items()
    ]
    if rows:
        head = ("from the exposure to", "median, ms", "99 %, ms", "maximum, ms", "count")
        yield table("Latency over the whole bag (quantiles to 2.3 %)", head, rows)
    frames = numbers["frames"]
    if frames["count"]:
        median_ms = _format(_lookup(frames["draw_ms"], "p50"))
        yield (
            f"<p>{frames['count']} frames were drawn in {median_ms} ms (median). "
            f"{frames['late']} of them were late.</p>"
        )
    else:
        yield _missing("No frame was recorded.")


def _sheet(numbers: Mapping[str, Any], charts: Mapping[str, Chart]) -> Iterator[str]:
    yield figure(charts.get("path"), "No finger or sheet was recorded.")
    contact = numbers["sheet"]["contact"]
    strokes = numbers["sheet"]["strokes"]
    if "errors" in charts:
        yield figure(charts["errors"], "")
        yield table(
            "In contact, over the whole bag",
            ("error", "mean", "standard deviation", "maximum"),
            [_summary(name, contact[key]) for name, key in (
                ("Δd to the measured finger, mm", "delta_d_mm"),
                ("Δθ to the measured finger, degrees", "delta_theta_deg"),
                ("Δd to the true finger, mm", "true_delta_d_mm"),
                ("Δθ to the true finger, degrees", "true_delta_theta_deg"),
            )],
        )  # fmt: skip
    else:
        yield _missing(
            "No Δd and Δθ: the bag does not contain scene, finger and both arms in contact."
        )
    if strokes:
        yield table(
            "Strokes of the experiment: mean (maximum), as from flexsheet experiment stroke",
            ("stroke, s", "start, s", "Δd, mm", "Δθ, degrees", "true Δd, mm",
             "true Δθ, degrees"),
            [
                (one["seconds"], one["start_s"], *(_mean(one[key]) for key in (
                    "delta_d_mm", "delta_theta_deg", "true_delta_d_mm", "true_delta_theta_deg")))
                for one in strokes
            ],
        )  # fmt: skip
    if followed := numbers["sheet"]["followed"]:
        yield table(
            "The true finger on each path. In contact: at most 1 mm above the object. Followed: "
            "both arms followed a target that followed the finger. Δd and Δθ: errors of the true "
            "sheet in contact, mean (95 %, maximum)",
            ("path", "start, s", "duration, s", "in contact, %", "followed in contact, %",
             "drop-outs", "true Δd, mm", "true Δθ, degrees"),
            [
                (
                    one["path"], one["start_s"], one["seconds"], 100.0 * one["contact_ratio"],
                    None if one["following_ratio"] is None else 100.0 * one["following_ratio"],
                    one["drop_outs"],
                    *(_format_sizes(one["contact"][key]) for key in (
                        "true_delta_d_mm", "true_delta_theta_deg")),
                )
                for one in followed
            ],
        )  # fmt: skip
    reasons = numbers["finger"]["reasons"]
    if reasons:
        texts = ", ".join(f"{reason} {count}" for reason, count in reasons.items())
        yield f"<p>Tracking results: {escape(texts)}.</p>"


def _arms(numbers: Mapping[str, Any], charts: Mapping[str, Chart]) -> Iterator[str]:
    if not numbers["arms"]:
        yield _missing("No arm was recorded.")
        return
    yield figure(charts.get("joints"), "There are too few arm states to compute joint speeds.")
    yield figure(charts.get("force"), "No edge force was recorded.")
    scene = numbers["scene"]
    yield table(
        "Maximum values",
        ("arm", "joint speed, % of its limit", "tool speed, mm/s", "edge force, N",
         "cycle of the arm 99 %, ms"),
        [
            (
                side,
                max((100.0 * s for s in one["joint_speed_ratio"] if s is not None), default=None),
                one["tool_speed_mm_per_s"],
                one["edge_force_n"],
                _lookup(one["cycle_ms"], "p99"),
            )
            for side, one in numbers["arms"].items()
        ],
    )  # fmt: skip
    if scene:
        yield (
            f"<p>The scene allows {1e3 * scene['max_tool_speed_m_per_s']:.0f} mm/s at the tool and "
            f"{scene['max_edge_force_n']:.3g} N at an edge.</p>"
        )


def _nodes(numbers: Mapping[str, Any]) -> Iterator[str]:
    if not numbers["nodes"]:
        yield _missing("The topic status was not recorded, so the nodes are unknown.")
    else:
        yield table(
            "Status of the nodes",
            ("node", "method", "CPU mean, %", "CPU maximum, %", "memory, MB", "starts", "errors",
             "last error or note"),
            [
                (name, one["method"] or "", 100.0 * one["cpu_mean"], 100.0 * one["cpu_max"],
                 one["resident_mb"], one["starts"], one["errors"],
                 one["last_error"] or one["note"])
                for name, one in sorted(numbers["nodes"].items())
            ],
        )  # fmt: skip
    body, frames = numbers["soft_body"], numbers["frames"]
    chosen = [
        (what, ", ".join(f"{name} ({count})" for name, count in counts.items()))
        for what, counts in (
            ("soft body, results by method", body["methods"]),
            ("image, frames by correction", frames["corrections"]),
        )
        if counts
    ]
    if chosen:
        yield table("Methods used", ("part", "methods"), chosen)
    graph = numbers["graph"]
    if graph:
        rows = [
            (name, one["type"], one["host"],
             ", ".join(f"{key}={value}" for key, value in one["parameters"].items()) or "defaults")
            for name, one in graph["nodes"].items()
        ]  # fmt: skip
        yield "<details><summary>Parameters of all nodes</summary>"
        yield table("Resolved launch file", ("node", "type", "host", "parameters"), rows)
        yield "</details>"


def _images(session: Session, numbers: Mapping[str, Any]) -> Iterator[str]:
    albums = (
        ("Stereo camera", session.stereo, "stereo",
         "Record stereo images with: flexsheet bag record BAG --include stereo."),
        ("User's eye", session.eye, "eye", "The simulated eye recorded no image."),
        ("Projector", session.drawn, "frame",
         "No frame was recorded with its pixels."),
    )  # fmt: skip
    for title, album, key, missing in albums:
        yield f"<h3>{title}</h3>"
        shots = album.shots()
        if not shots:
            yield _missing(missing)
            continue
        if numbers["images"][key] > len(shots):
            rest = f", without {album.left_out} at bookmarks" if album.left_out else ""
            yield f"<p>{len(shots)} of {numbers['images'][key]} are shown{rest}.</p>"
        yield from _album(title, album)


def _album(title: str, album: Album) -> Iterator[str]:
    yield '<div class="shots">'
    for shot in album.shots():
        images = "".join(_image(title, shot, *one) for one in shot.pictures)
        yield f'<figure><div class="pair">{images}</div>'
        marked = f" <strong>Bookmark: {escape(shot.marked)}.</strong>" if shot.marked else ""
        names = " | ".join(name for name, _ in shot.pictures)
        yield (
            f"<figcaption>{shot.seconds:.2f} s. {escape(shot.title)}{marked}<br>"
            f"{escape(names)}</figcaption></figure>"
        )
    yield "</div>"


def _image(title: str, shot: Shot, name: str, jpeg: bytes) -> str:
    text = escape(f"{title} at {shot.seconds:.2f} s: {name}. {shot.title}", quote=True)
    return f'<img alt="{text}" src="data:image/jpeg;base64,{b64encode(jpeg).decode()}">'


def figure(chart: Chart | None, missing: str) -> str:
    """Return the HTML of a chart with its caption.

    If there is no chart, return the HTML of the text `missing`.
    """
    if chart is None:
        return _missing(missing)
    data = b64encode(chart.svg.encode()).decode()
    return (
        f'<figure><img alt="{escape(chart.text, quote=True)}" '
        f'src="data:image/svg+xml;base64,{data}">'
        f"<figcaption>{escape(chart.caption)}</figcaption></figure>"
    )


def table(caption: str, head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return the HTML of a table.

    The first column contains the row headers. Numbers are rounded to three digits.
    """
    body = []
    for first, *rest in rows:
        cells = "".join(_cell(value) for value in rest)
        body.append(f'<tr><th scope="row">{escape(_format(first))}</th>{cells}</tr>')
    heads = "".join(f'<th scope="col">{escape(name)}</th>' for name in head)
    return (
        # A wide table scrolls separately from the page; with tabindex, also by the keyboard.
        f'<div class="scroll" role="region" aria-label="{escape(caption, quote=True)}" '
        f'tabindex="0"><table><caption>{escape(caption)}</caption><thead><tr>{heads}</tr></thead>'
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def _cell(value: Any) -> str:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    kind = ' class="number"' if number else ""
    return f"<td{kind}>{escape(_format(value))}</td>"


def _format(value: Any) -> str:
    match value:
        case None:
            return "–"
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return str(value)


def _lookup(values: Mapping[str, Any] | None, key: str) -> float | None:
    return None if values is None else values[key]


def _summary(name: str, values: Mapping[str, float] | None) -> tuple[Any, ...]:
    if values is None:
        return name, None, None, None
    return name, values["mean"], values["std"], values["max"]


def _mean(values: Mapping[str, float] | None) -> str:
    return "–" if values is None else f"{values['mean']:.3g} ({values['max']:.3g})"


def _format_sizes(values: Mapping[str, float] | None) -> str:
    if values is None:
        return "–"
    return f"{values['mean']:.3g} ({values['p95']:.3g}, {values['max']:.3g})"


def _missing(text: str) -> str:
    return f'<p class="quiet">{escape(text)}</p>'


def duration(seconds: float) -> str:
    """Return a duration as text, such as "3.2 s", "4 min 10 s" or "2 h 5 min"."""
    if seconds < 60.0:
        return f"{seconds:.3g} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60} min"
