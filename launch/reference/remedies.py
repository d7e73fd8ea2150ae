"""What to do about each kind of error; the words for docs/errors.md and `flexsheet explain`."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Area:
    """A part of the system as its user sees it, and the files whose messages belong to it."""

    title: str
    about: str
    paths: tuple[str, ...]


AREAS = (
    Area(
        "Command line",
        "What a command says before it does anything, or because it cannot. "
        "All commands and options: [cli.md](cli.md).",
        ("launch/",),
    ),
    Area(
        "Launch files and scenes",
        "Mistakes in YAML files, all of them at once, each with file, line, key and remedy. "
        "The keys: [launch-files.md](launch-files.md); parameters: [parameters.md](parameters.md).",
        ("launch/plans/", "launch/objects/", "messages/scene.py", "nodes/__init__.py",
         "nodes/node.py", "launch/experiments/"),
    ),
    Area(
        "Graph and processes",
        "Starting nodes and keeping them running, on one computer or on several: "
        "[architecture.md](architecture.md), [clocks.md](clocks.md), [deploy.md](deploy.md).",
        ("launch/running/", "launch/health/doctor", "launch/health/system.py", "nodes/runner.py",
         "nodes/clock/", "nodes/cache.py", "nodes/methods.py"),
    ),
    Area(
        "Topics and messages",
        "What does not fit on the wire is refused and counted, and never reaches a node: "
        "[messages.md](messages.md).",
        ("messages/", "launch/running/tools.py"),
    ),
    Area(
        "Keys",
        "Between hosts only who has the right key is heard: [security.md](security.md).",
        ("messages/security.py", "launch/running/keys.py"),
    ),
    Area(
        "Bags",
        "Recordings, what is in them, and what can be done with them.",
        ("messages/bag.py", "messages/migrations.py", "launch/bags/", "nodes/recorder/"),
    ),
    Area(
        "Camera and calibration",
        "Devices, files, boards: [camera.md](camera.md), [calibration.md](calibration.md).",
        ("nodes/camera/", "messages/calibration", "messages/sheet_calibration.py",
         "messages/arms_calibration.py", "launch/bench/", "nodes/twin/board.py",
         "nodes/models/sheet/"),
    ),
    Area(
        "Fingertip",
        "A fingertip that is not valid says why in its `reason`; the sheet holds meanwhile. "
        "How it is tracked: [tracking.md](tracking.md).",
        ("nodes/triangulator/",),
    ),
    Area(
        "Planner",
        "Why the sheet waits or holds is in `reason` of the topic `sheet_target`: "
        "[planner.md](planner.md).",
        ("nodes/planner/", "nodes/models/"),
    ),
    Area(
        "Arms",
        "Why an arm does not move is in `reason` and `faults` of its topic, and in "
        "`flexsheet arms status`.  Faults latch: put right what they say, then "
        "`flexsheet arms reset`. [arms.md](arms.md), [modbus.md](modbus.md), [mxt.md](mxt.md).",
        ("nodes/arm_bridge/",),
    ),
    Area(
        "Shapes and meshes",
        "The object's surface and the solid made of it: [shapes.md](shapes.md), "
        "[meshing.md](meshing.md).",
        ("nodes/models/shapes/", "nodes/fem_solver/mesh/"),
    ),
    Area(
        "Soft body",
        "FEM of the object: [soft-body.md](soft-body.md).",
        ("nodes/fem_solver/",),
    ),
    Area(
        "Renderer and projector",
        "OpenGL, windows, the projector's calibration: [renderer.md](renderer.md), "
        "[projector.md](projector.md).",
        ("nodes/renderer/",),
    ),
    Area("Console", "The page in the browser: [console.md](console.md).", ("nodes/console/",)),
    Area(
        "Twin",
        "The simulated finger, camera, arms, sheet and eye.",
        ("nodes/twin/", "launch/bench/twin_sheet.py"),
    ),
)  # fmt: skip

REMEDIES = {
    "CommandError": "the sentence names the option or file, and what to give instead.",
    "BadInputError": "open the file at the line that is named; check with "
    "`flexsheet launch FILE --dry-run`.",
    "Finding": "of `flexsheet doctor` or `flexsheet bag report`; what to do stands beside it.",
    "Log": "a node goes on, but says this in its log; the words after it name the cause.",
    "Note": "one line of a node's status (`flexsheet topic echo status`): what hinders it is named "
    "in it, and its log says more.",
    "Warning": "the launcher or a node says it and goes on: it names what is wrong and where, once "
    "for each cause; news of a start, a reset or new keys ask for nothing.",
    "Reason": "it is a state, not a breakdown: put right what it names, or wait.",
    "Value": "follows `does not fit` of a file, or refuses a message: give a value that it allows.",
    "BagError": "`flexsheet bag info BAG` says how much can be read, `flexsheet bag recover` "
    "makes a whole bag of it.",
    "ExportError": "install what it names, or choose another output file.",
    "ExperimentError": "run it on `launch/demo.yaml` first; for a bag, record it by the same "
    "experiment.",
    "NodeFailedError": "read the node's log above the sentence, or in the run's folder `logs`; "
    "its first error is the cause.",
    "RunDirectoryError": "set `FLEXSHEET_RUNS` to a folder of your own.",
    "UnknownFamilyError": "take one of the names it lists (`flexsheet chart --help`).",
    "UnknownTunableError": "take one of the names it lists (docs/tune.md).",
    "UnknownTopicError": "`flexsheet topic list` has all names.",
    "UnknownNodeError": "`flexsheet node list` has all names.",
    "BusError": "another graph holds the endpoint: end it, or `flexsheet doctor --sweep`.",
    "SecurityError": "make a pair with `flexsheet keys new HOST` on that host and install its "
    "public half in the launch file on every host.",
    "WireError": "run the same version of flexsheet on all hosts; the count is in `status`.",
    "CalibrationFileError": "calibrate again, or name the file that was meant.",
    "CalibrationMismatchError": "name the calibration of the scene's own device, or the scene "
    "that it was made for.",
    "CalibrationError": "take pictures of the whole board, sharp, in many tilts; check `--board` "
    "(inner corners) and `--square-mm`.",
    "NotDeterminedError": "add pairs that differ in tilt and distance.",
    "DeviceError": "check the plug, the device's name and `flexsheet calibrate`'s file; another "
    "program may hold the camera.",
    "ImageMismatchError": "let the scene name the camera that the pictures are from.",
    "PlacesError": "correct the row that is named in joints.csv, or take the place again.",
    "HandEyeError": "take more places, with the board turned about at least two axes.",
    "SheetModelFitError": "add pushes at other stretches and depths.",
    "BoardError": "choose a board that fits into the pictures: fewer or smaller squares.",
    "UnfitGeometryError": "choose an object whose shape that command can handle.",
    "UnfitCurveError": "give force over depth from zero, rising, without repeats.",
    "UnpresentableError": "make the object larger or smoother, or the sheet wider.",
    "NoEquilibriumError": "the push or tilt is beyond the sheet's range; lessen it.",
    "UnreachableError": "`flexsheet doctor scene SCENE` says what is out of reach and what would "
    "help.",
    "PathError": "bring the arms nearer to the sheet by hand, then `flexsheet arms ready` again.",
    "ArmSilentError": "first see whether the computer is busy: `flexsheet doctor`, row `load`; "
    "that is the usual cause where arms are simulated.  Otherwise check the arm's address, power "
    "and cable, and that its program runs.",
    "ArmRefusedError": "the controller says why on its teach pendant: enabled, no alarm, in remote "
    "mode?",
    "ArmAnswerError": "another program may speak to the same arm, or its program is of another "
    "version.",
    "MeshError": "repair the mesh (closed, outward, no elements inside out); see meshing.md.",
    "TextureError": "name a PNG or JPEG, and a mesh with texture coordinates.",
    "SolidMeshError": "raise skin_spacing_m, or hold more of the object; see meshing.md.",
    "UnfitMeshError": "use a coarser or finer spacing, or repair the surface.",
    "InvertedElementError": "use smaller load steps; deep pushes have no solution.",
    "NewtonNotConvergedError": "lessen the push, refine the mesh, or choose the linear method.",
    "IndefiniteError": "hold the body at its base; check Poisson's ratio below 0.5.",
    "SchedulerError": "check the scheduler's address and that its workers run the same version.",
    "LostWorkersError": "start the workers again and repeat: what was solved is kept.",
    "NoOpenGLError": "`flexsheet doctor` names the packages for EGL.",
    "WindowError": "set the monitor to one that it lists, or run headless.",
    "ProjectorError": "take pictures in more poses, with all of the pattern on the sheet.",
    "DecodeError": "take all pictures in order, exposed neither too dark nor too bright.",
    "ConsoleError": "choose another port, or give a token where the page is open to the network.",
    "ReleaseError": "release it where the sentence says, or let this host: "
    "hosts.NAME.may_reset_estop in the launch file on all hosts.",
    "SceneChoiceError": "choose a scene of the same devices as the one that runs.",
    "FingerPathError": "slow the path down or correct the row that is named.",
    "MxtError": "a fault of the simulated controller; its program starts anew.",
    "NotConvergedError": "the push is beyond the membrane's range; lessen it.",
    "NotMeasurableError": "photograph a nearer pose: what is to be measured must be in view.",
}
"""By class of error, or by how it is said: a finding of the doctor, a log line, a reason."""

BUSY_FIRST = "first see whether the computer is busy: `flexsheet doctor`, row `load`"

PARTICULAR = {
    "the computer <host> is busy": "processes wait for a processor, so nodes are late and "
    "simulated arms drop out: end other programs, or give the graph more cores.",
    "no answer from <host>:<port> within": f"{BUSY_FIRST}; else check the arm's address, power, "
    "cable and program.",
    "sheet target or other arm late": f"{BUSY_FIRST}; else the network, and what is late upstream.",
    "the other arm is silent": f"{BUSY_FIRST}; else the other bridge, its log, and the network.",
    "no sheet target": f"{BUSY_FIRST}; else camera, triangulator, planner: `flexsheet topic hz`.",
    "the arm's watchdog stopped it": f"{BUSY_FIRST}; else its bridge was silent: see its log.",
    "NOT RECORDING:": "make room, or let it write elsewhere; with room the next bag begins "
    "by itself.",
    "hung: no sign of life": "it is started again; the end of its log (`logs/NODE.log` of the run) "
    "shows where it stood; `liveness_s` of the launch file is how long it may be silent.",
    "refuses our key": "the launch file there has none or another key for this host: copy the "
    "newest to all; `flexsheet doctor hosts` says which differ.",
    "does not speak with our keys": "start it with a launch file that has keys, the same on all "
    "hosts.",
    "did not prove that it has its key": "its secret key is another than the launch file has, or "
    "somebody sits in its place: `flexsheet doctor hosts`.",
    "a reader or the network is too slow": "`flexsheet topic echo status` shows which port drops; "
    "give that node more processor time, or the link more room.",
    "may not reset an e-stop or let the arms move": "do it on a host that may, mostly `main`.",
    "is not measured": "for some seconds after a start that is so; else its clock node or the "
    "network is down (docs/clocks.md).",
    "ms are allowed": "quieten the network, set up chrony, or allow more (docs/clocks.md).",
    "no way: <first>": "bring the arms nearer to the sheet by hand, or the sheet to another place "
    "(docs/arms.md).",
    ": keeping the last valid sheet plane": "the arms are silent, or the sheet faces "
    "away; it recovers by itself.",
    ", kept until it is reset": "when the danger is over: `flexsheet arms reset`.",
    "watchdog: no command": "its bridge was silent for 100 ms: is it running, and the cable in?",
}
"""By words of a message that says no remedy itself and needs more than its kind's."""

SHEET_TARGET: dict[str, str] = {
    "fingertip_invalid": "the fingertip is not valid: see the `reason` of the topic `fingertip`.",
    "fingertip_not_finite": "the fingertip holds NaN or infinity: check what publishes it.",
    "fingertip_too_old": f"{BUSY_FIRST}; else camera, triangulator and network are slow.",
    "fingertip_in_future": "the clocks of two hosts differ: see docs/clocks.md.",
    "implausible_input": "the finger is 10 m away or moves at 10 m/s: check the calibration.",
    "ambiguous_side": "the finger is inside the object, on no definite side: move it out.",
    "through_object": "the finger is deeper than 1.4 times the scene's push depth: move it out.",
    "past_object_edge": "the finger is past the touchable surface: move it back.",
    "beyond_tilt": "the arms cannot tilt the sheet further: move the finger to the front.",
    "beyond_spin": "rolling has rotated the sheet by `max_spin_rad`: lift the finger.",
    "past_sheet_width": "the contact is near a clamped edge: move the finger back or lift it.",
    "past_sheet_height": "the contact is past the usable height: move the finger back or lift it.",
    "concave_contact": "the object is concave there: the flat sheet rests on the rim.",
}
"""Remedies by `reason` of the topic `sheet_target`."""

FINGERTIP = {
    "no_marker": "no marker in either image: finger out of view, marker lost, exposure too dark.",
    "marker_in_one_view": "one camera is occluded or sees less far: move the finger or the camera.",
    "two_markers": "a second bright spot: cover reflections, and show one marked finger only.",
    "merged": "the marker touches another bright spot: remove it from behind the finger.",
    "blurred": "the finger is too fast for the exposure: shorten it, with more light.",
    "saturated": "the marker is overexposed: shorten the exposure.",
    "outside_volume": "the finger is outside the working range of the scene.",
    "inconsistent": "the rays of both views do not meet: calibrate the camera again.",
    "too_fast": "a jump faster than a finger, usually a reflection: cover it.",
    "unconfirmed": "a new marker is accepted after a few images; no action is needed.",
}
"""By `reason` of the topic `fingertip`."""
