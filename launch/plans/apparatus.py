"""Load the apparatus that the option `--apparatus` names, and pass it to the simulator nodes.

The apparatus is the set of true parameters of the simulated hardware. The scene contains the
parameters that the other nodes assume.
"""

from __future__ import annotations

import io
import json
import re
from dataclasses import dataclass
from pathlib import Path

from ruamel.yaml import YAML

from flexsheet.launch.objects.meshes import make_scene
from flexsheet.launch.plans.documents import (
    BadInputError,
    Document,
    Problem,
    read_document,
    validate,
)
from flexsheet.launch.plans.resolve_nodes import NodeEntry
from flexsheet.messages.apparatus import Apparatus, identify_scene
from flexsheet.messages.scene import Scene
from flexsheet.nodes import NodeRole
from flexsheet.nodes.node import find_role
from flexsheet.nodes.twin.tolerance_table import Profile, sample_apparatus
from flexsheet.nodes.twin.truth import SimulatorParameters, align_world_to_camera, check_truth

TOPIC = "twin/apparatus"
_SEED = re.compile(r"seed:(?P<seed>\d{1,18})(?P<words>(?:,[a-z]+)*)")
CALIBRATED = "calibrated"
COMMISSION_STATE = "commission.json"
"""The name of the state file of a commissioning, in the folder of the calibrated scene.

The file names the scene from which the commissioning started.
"""

PROFILES = tuple(one.value for one in Profile)


@dataclass(frozen=True, slots=True)
class Draw:
    """The specification of a random apparatus (true parameters of the simulated hardware).

    It is parsed from `seed:N[,modern|paper][,calibrated]`.
    """

    seed: int
    profile: Profile
    calibrated: bool


def parse_draw(text: str) -> Draw | None:
    """Parse the value of --apparatus, the option that selects parameters of simulated hardware.

    Return None if the value is a file name. Raises BadInputError if the value starts with "seed:"
    but has a wrong format.
    """
    if not text.startswith("seed:"):
        return None
    match = _SEED.fullmatch(text)
    words = [] if match is None else match["words"].split(",")[1:]
    profiles = [Profile(word) for word in words if word in PROFILES]
    known = len(profiles) + words.count(CALIBRATED) == len(words) == len(set(words))
    if match is None or not known or len(profiles) > 1:
        remedy = (
            "write seed:N, seed:N,paper or seed:N,paper,calibrated with a whole number N; "
            "or name a file"
        )
        raise BadInputError.single("--apparatus", (), f'"{text}" is not a random sample', remedy)
    profile = profiles[0] if profiles else Profile.MODERN
    return Draw(int(match["seed"]), profile, CALIBRATED in words)


def load_apparatus(text: str, scene: Scene, scene_file: Path | None = None) -> Apparatus:
    """Read true hardware parameters from a file, or sample them from a text such as "seed:7".

    scene_file: file of the scene. If this scene is the result of a calibration (commissioning),
        uncalibrated hardware is sampled relative to the original scene. The world frame of the
        result is then defined by the camera.

    Raises BadInputError if the file cannot be read, contains unknown keys or impossible values, or
    belongs to another scene.
    """
    draw = parse_draw(text)
    if draw is not None:
        base = None if draw.calibrated else _load_base(scene_file)
        drawn = sample_apparatus(
            base or scene, draw.seed, profile=draw.profile, calibrated=draw.calibrated
        )
        return drawn if base is None else align_world_to_camera(base, drawn)
    document = read_document(Path(text))
    apparatus = validate(Apparatus, document)
    problems = _compare_scenes(apparatus, scene, document)
    problems += [
        document.problem(key, f"{value} {what}", remedy)
        for key, value, what, remedy in check_truth(scene, apparatus)
    ]
    if problems:
        raise BadInputError(problems)
    return apparatus


def _load_base(scene_file: Path | None) -> Scene | None:
    """Load the original scene, from which a calibrated scene was made by commissioning.

    Return None if the scene file is not the result of a commissioning.

    scene_file: file of the calibrated scene.
    """
    state = None if scene_file is None else scene_file.parent / COMMISSION_STATE
    if state is None or not state.is_file():
        return None
    try:
        named = str(json.loads(state.read_text(encoding="utf-8"))["scene_file"])
    except (OSError, ValueError, KeyError, TypeError):
        named = ""
    if not Path(named).is_file():
        what = f'the scene from which the commissioning started, "{named}", does not exist'
        remedy = f"restore it, or use --apparatus {state.parent / 'apparatus.yaml'}"
        raise BadInputError.single(str(state), ("scene_file",), what, remedy)
    return make_scene(read_document(Path(named)))


def _compare_scenes(apparatus: Apparatus, scene: Scene, document: Document) -> list[Problem]:
    remedy = "name an apparatus file of this scene; flexsheet apparatus seed:N -o FILE makes one"
    if apparatus.scene != scene.name:
        what = f'the file belongs to scene "{apparatus.scene}", but the scene is "{scene.name}"'
        return [document.problem(("scene",), what, remedy)]
    if apparatus.scene_id not in (None, identify_scene(scene)):
        what = (
            f'the file belongs to scene_id "{apparatus.scene_id}", but object or devices of scene '
            f'"{scene.name}" have changed: its id is "{identify_scene(scene)}"'
        )
        return [document.problem(("scene_id",), what, remedy)]
    return []


def format_apparatus(apparatus: Apparatus) -> str:
    """Return true hardware parameters as the YAML text of an apparatus file."""
    yaml = YAML()
    yaml.default_flow_style = None
    yaml.width = 4096
    text = io.StringIO()
    text.write(
        f"# Apparatus of scene {apparatus.scene}, {apparatus.origin}: true parameters of the\n"
        "# simulator, as differences from `nominal`. See docs/apparatus.md.\n"
    )
    yaml.dump(apparatus.model_dump(mode="json", exclude_none=True), text)
    return text.getvalue()


def give_apparatus(
    entries: list[NodeEntry],
    apparatus: Apparatus | None,
    document: Document,
) -> None:
    """Set the apparatus (true hardware parameters) as a parameter of all simulator nodes.

    Problems are stored in `document`. For example, a launch file must not contain an apparatus.
    """
    simulators = [one for one in entries if isinstance(one.parameters, SimulatorParameters)]
    for entry in simulators:
        if "apparatus" in entry.spec.parameters:
            document.report(
                (*entry.key, "parameters", "apparatus"),
                "an apparatus is not allowed in a launch file",
                "remove it, and use the option --apparatus, which applies to all simulator nodes",
            )
        elif apparatus is not None and entry.parameters is not None:
            entry.parameters = entry.parameters.model_copy(update={"apparatus": apparatus})
    if apparatus is not None and not simulators:
        document.problems.append(
            Problem("--apparatus", (), "the graph has no simulator node", "start a simulated graph")
        )


def refuse_apparatus_readers(entries: list[NodeEntry], document: Document) -> None:
    """Report a problem if a node other than simulators and recorders reads the apparatus topic.

    Experiments measure the errors of the other nodes, so these nodes must not know the true
    parameters.
    """
    for entry in entries:
        if entry.type is None or find_role(entry.type) is NodeRole.RECORDER:
            continue
        if isinstance(entry.parameters, SimulatorParameters):
            continue
        for port, topic in entry.topics("input"):
            if topic.name == TOPIC:
                document.report(
                    (*entry.key, "topics", port),
                    f'node "{entry.name}" would read the ground truth of the simulator',
                    "disconnect the port; only the simulator and experiments may read it",
                )
