"""Present pairs of soft objects in a running graph, and read the operator's typed answers."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Awaitable, Callable

from flexsheet.launch.experiments import ExperimentError
from flexsheet.launch.experiments.driver import Driver
from flexsheet.launch.experiments.jnd import PairAnswer, PairTrial
from flexsheet.launch.experiments.run import Procedure
from flexsheet.messages.base import Message
from flexsheet.messages.scene import Scene
from flexsheet.messages.types import Force, SheetTarget

Ask = Callable[[str], Awaitable[str]]

INSTRUCTIONS = """\
Instructions for the operator
  Before: obtain the ethics approval and the signed information sheet
  (docs/participant-information.txt). Test the hardware stop of the arms.
  Code: use a random participant code, never a name. Keep the list of codes elsewhere.
  Say: "You push two soft objects, one after the other, each to about the same depth. Then say
  which one was stiffer, 1 or 2. Guess if you are not sure. You may pause or stop at any time."
  Do not say whether an answer was correct. The participant must not see this screen.
  Each trial: press Enter after each push, when the finger has left the sheet. Then type 1 or 2.
  Pause: offer one after every 40 trials. To interrupt, type q or press Ctrl-C. The same command
  with the same --output continues the session.
"""


class PeakMonitor:
    """A monitor of the maximum push depth (m) and measured force (N) since the last reset.

    Both values are None if there are no measurements.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self.depth_m: float | None = None
        self.force_n: float | None = None

    def update(self, message: Message) -> None:
        if isinstance(message, SheetTarget):
            self.depth_m = max(self.depth_m or 0.0, message.push_depth_m)
        elif isinstance(message, Force) and message.valid and message.axis == "sheet_normal":
            self.force_n = max(self.force_n or 0.0, message.force_n)


class PairPresenter:
    """A presenter of object pairs; it changes the object's stiffness in a running graph."""

    def __init__(self, driver: Driver, scene: Scene, ask: Ask) -> None:
        self._driver, self._scene, self._ask = driver, scene, ask
        self._peaks = PeakMonitor()
        driver.on_message = self._peaks.update

    async def present(self, trial: PairTrial) -> PairAnswer:
        """Present both objects of a trial in sequence, and return the answer that is typed.

        Raises ExperimentError if the operator types "q".
        """
        depths: list[float | None] = []
        forces: list[float | None] = []
        for interval, modulus_pa in enumerate(trial.moduli_pa, start=1):
            await self._driver.change_scene(replace_modulus(self._scene, modulus_pa))
            self._peaks.reset()
            await self._get(f"trial {trial.number}, object {interval}: push, then press Enter ", "")
            depths.append(self._peaks.depth_m)
            forces.append(self._peaks.force_n)
        loop = asyncio.get_running_loop()
        asked_s = loop.time()
        answer = await self._get("which one was stiffer, 1 or 2? ", "1", "2")
        return PairAnswer(
            stiffer=int(answer),
            response_s=loop.time() - asked_s,
            depths_m=(depths[0], depths[1]),
            forces_n=(forces[0], forces[1]),
        )

    async def _get(self, question: str, *accepted: str) -> str:
        while True:
            answer = (await self._ask(question)).strip().lower()
            if answer == "q":
                raise ExperimentError(
                    "interrupted by the operator; run the same command again to continue"
                )
            if answer in accepted:
                return answer


def replace_modulus(scene: Scene, modulus_pa: float) -> Scene:
    """Return a copy of the scene whose object has the given Young's modulus.

    Raises ExperimentError if the object is rigid.
    """
    material = scene.object.material
    if material is None:
        raise ExperimentError(
            f'scene "{scene.name}": object.material is missing, so that the object has no '
            "stiffness; choose a scene with a soft object"
        )
    changed = material.model_copy(update={"young_modulus_pa": modulus_pa})
    item = scene.object.model_copy(update={"material": changed})
    return scene.model_copy(update={"object": item})


async def open_terminal() -> Ask:
    """Return a coroutine function that prints a question and reads an answer from stdin."""
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(
        lambda: asyncio.StreamReaderProtocol(reader), sys.stdin
    )

    async def ask(question: str) -> str:
        print(question, end="", file=sys.stderr, flush=True)
        line = await reader.readline()
        if not line:
            raise ExperimentError("the input has ended; the same command continues the session")
        return line.decode(errors="replace")

    return ask


def make_jnd_procedure(run: Callable[[PairPresenter], Awaitable[None]]) -> Procedure:
    """Make a procedure (coroutine) that presents pairs of objects to a participant.

    `run_experiment` runs the procedure in a graph.

    run: coroutine function that runs the session. Its argument is the presenter, which sets the
        stiffness of the object in the running graph.
    """

    async def procedure(driver: Driver, scene: Scene) -> None:
        await run(PairPresenter(driver, scene, await open_terminal()))

    return procedure
