"""Measure the latency of the projector with the stereo camera.

The renderer switches the projected image between white and black at random times. It publishes
these times in its messages about frames. A camera image of the sheet shows whether the light has
already changed, and therefore bounds the latency. The latency is estimated from all images
together.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.special import ndtr

from flexsheet.launch.calibration.delays import MeasuredLag, draw_exposures
from flexsheet.launch.experiments.run import SWITCH_INTERVAL_S
from flexsheet.messages.apparatus import NOMINAL_DISPLAY_LATENCY_S, Apparatus
from flexsheet.messages.bag import BagReader
from flexsheet.messages.errors import FlexsheetError
from flexsheet.messages.scene import Scene, require_projector
from flexsheet.messages.types import Frame, StereoPair
from flexsheet.nodes.twin.projector import LitSheet, sheet_poses
from flexsheet.nodes.twin.rig import make_true_camera
from flexsheet.nodes.twin.truth import apply_apparatus

MIN_SWITCHES = 20
MAX_LATENCY_S = 0.15
"""The maximum latency (s) of the projector that the estimation considers."""

STEP_S = 2e-4
JITTERS_S = (2.5e-4, 5e-4, 1e-3, 2e-3, 4e-3, 8e-3)
ERROR_RATES = (0.003, 0.01, 0.03, 0.1, 0.2)
"""The fractions of wrongly classified images that the estimation considers.

For the errors of the measured times, the estimation considers the standard deviations (s) in
`JITTERS_S`.
"""

MIN_CONTRAST = 3.0
"""The minimum difference in grey level between camera images of a white and a black projection."""

SIMULATED_SWITCHES, LEVELS = 60, 16
"""The number of simulated switches, and the number of brightness steps between black and white.

A camera image has an intermediate brightness if the light changes during the exposure.
"""


class DisplayLatencyError(FlexsheetError, ValueError):
    """Raised if the latency of the projector cannot be estimated from the images."""

    remedy = "Let the camera see the lit sheet, and record a stroke with --switches 60."


@dataclass(frozen=True, slots=True)
class SwitchImage:
    """A camera image that was taken after a switch of the projected image between white and black.

    switched_s: time when the renderer switched the projected image.
    start_s, end_s: start and end of the camera's exposure.
    is_new: whether the camera image shows the new projected image.

    All times are in seconds of the same clock.
    """

    switched_s: float
    start_s: float
    end_s: float
    is_new: bool


def estimate_display_latency(images: Sequence[SwitchImage]) -> MeasuredLag:
    """Estimate the latency (s) from a switch of the image to the change of the light on the sheet.

    The model assumes that a camera image shows the new projected image if the light changed before
    the middle of the exposure. The times have unknown errors, and an unknown fraction of the images
    is classified wrongly. The result is the mean and the standard deviation of the posterior
    distribution with a uniform prior.

    Raises DisplayLatencyError if there are too few switches, or if the images do not show them.
    """
    switches = len({one.switched_s for one in images})
    if switches < MIN_SWITCHES:
        raise DisplayLatencyError(
            f"the images contain {switches} switches of the projected image, but at least "
            f"{MIN_SWITCHES} are required; record more switches"
        )
    start_s, end_s, switched_s = np.array(
        [(one.start_s, one.end_s, one.switched_s) for one in images]
    ).T
    is_new = np.array([one.is_new for one in images])
    ages_s = 0.5 * (start_s + end_s) - switched_s
    late = ages_s > MAX_LATENCY_S
    if late.sum() < MIN_SWITCHES or is_new[late].mean() < 0.5:
        raise DisplayLatencyError(
            f"only {int(is_new[late].sum())} of {int(late.sum())} images that were taken more than "
            f"{1e3 * MAX_LATENCY_S:.0f} ms after a switch show the new state; record more switches"
        )
    latencies_s = np.arange(0.0, MAX_LATENCY_S, STEP_S)
    logs = []
    for jitter_s in JITTERS_S:
        deviations_s = np.hypot(jitter_s, (end_s - start_s) / np.sqrt(12.0))
        new = ndtr((ages_s - latencies_s[:, None]) / deviations_s)
        right = np.where(is_new, new, 1.0 - new)
        logs += [np.log(rate + (1.0 - 2.0 * rate) * right).sum(axis=1) for rate in ERROR_RATES]
    weights = np.exp(np.array(logs) - np.max(logs)).sum(axis=0)
    weights /= weights.sum()
    mean_s = float(weights @ latencies_s)
    return MeasuredLag(mean_s, float(np.sqrt(weights @ (latencies_s - mean_s) ** 2)))


def classify_images(
    switches: Sequence[tuple[float, bool]], exposures: Iterable[tuple[float, float, float]]
) -> list[SwitchImage]:
    """Decide from the brightness of each camera image whether it shows the newest projected image.

    switches: time (s) of each switch between white and black, and whether the new image is white.
    exposures: for each camera image, start (s) and end (s) of the exposure, and mean grey level.

    Raises DisplayLatencyError if all images have a similar brightness.
    """
    times_s = np.array([at_s for at_s, _ in switches])
    seen = [one for one in exposures if times_s[0] < 0.5 * (one[0] + one[1])]
    seen = [one for one in seen if 0.5 * (one[0] + one[1]) < times_s[-1] + SWITCH_INTERVAL_S[0]]
    black, white = np.quantile([one[2] for one in seen] or [0.0], (0.25, 0.75))
    if white - black < MIN_CONTRAST:
        raise DisplayLatencyError(
            f"no switch between black and white is visible in {len(seen)} images: their grey "
            f"levels differ by {white - black:.1f}, but at least {MIN_CONTRAST:g} are required"
        )
    images = []
    for start_s, end_s, level in seen:
        number = int(np.searchsorted(times_s, 0.5 * (start_s + end_s))) - 1
        at_s, is_white = switches[number]
        images.append(
            SwitchImage(at_s, start_s, end_s, (level > 0.5 * (black + white)) == is_white)
        )
    return images


def read_switch_images(bag: Path, stamp_offset_s: float = 0.0) -> list[SwitchImage]:
    """Read a bag, and return the camera images that follow each switch of the projected image.

    Return an empty list if the bag contains no switch.

    stamp_offset_s: time of an exposure minus its timestamp.
    """
    shown = [
        (1e-9 * (message.swapped_ns or message.drawn_ns), message.pattern)
        for _, message, _, _ in BagReader(bag, topics=["frame"])
        if isinstance(message, Frame) and message.light_ns
    ]
    switches = [
        (at_s, pattern == "white")
        for (_, before), (at_s, pattern) in pairwise(shown)
        if before != pattern and {before, pattern} == {"white", "black"}
    ]
    if not switches:
        return []
    exposures = (
        (
            1e-9 * header.source_ns + stamp_offset_s - 0.5 * message.exposure_s,
            1e-9 * header.source_ns + stamp_offset_s + 0.5 * message.exposure_s,
            float(message.left.mean()),
        )
        for _, message, header, _ in BagReader(bag, topics=["stereo"])
        if isinstance(message, StereoPair)
    )
    return classify_images(switches, exposures)


def simulate_switch_images(
    scene: Scene, apparatus: Apparatus, *, seed: int, stamp_offset_s: float = 0.0
) -> list[SwitchImage]:
    """Simulate camera images of the sheet while a simulated projector switches its image.

    The simulated projector displays an image as soon as its latency has passed.

    stamp_offset_s: measured time of an exposure minus its timestamp.
    """
    random = np.random.default_rng((seed, 4))
    true = apply_apparatus(scene, apparatus)
    projector = require_projector(true)
    size = projector.height_px, projector.width_px
    patterns = [
        np.full(size, round(255.0 * part), np.uint8) for part in np.linspace(0.0, 1.0, LEVELS + 1)
    ]
    lit = LitSheet(scene, make_true_camera(true.camera), projector, seed=seed)
    levels = [float(image.mean()) for image in lit.pair(patterns, sheet_poses(1)[0])[0]]
    switched_s = 1.0 + np.cumsum(random.uniform(*SWITCH_INTERVAL_S, SIMULATED_SWITCHES))
    light_s = switched_s + NOMINAL_DISPLAY_LATENCY_S + apparatus.projector.latency_offset_s
    half_s = 0.5 * scene.camera.exposure_s
    instants_s = half_s * np.linspace(-1.0, 1.0, 2 * LEVELS + 1)[1::2]
    exposures = []
    for stamp_ns, exposed_ns in draw_exposures(
        scene, apparatus, round(1e9 * (switched_s[-1] + 1.0)), seed
    ):
        is_white = np.searchsorted(light_s, 1e-9 * exposed_ns + instants_s) % 2
        level = levels[int(is_white.sum())]
        at_s = 1e-9 * stamp_ns + stamp_offset_s
        exposures.append((at_s - half_s, at_s + half_s, level))
    states = [(float(at_s), number % 2 == 0) for number, at_s in enumerate(switched_s)]
    return classify_images(states, exposures)
