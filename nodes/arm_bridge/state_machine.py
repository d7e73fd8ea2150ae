"""Define the states and events of an arm's controller, and the table of all transitions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from enum import Enum

from flexsheet.messages.types import ArmMode


class State(Enum):
    """The states of an arm's controller, with their descriptions for the documentation.

    In states whose names end in `TAUT`, the sheet may be stretched. The arm is permitted to slacken
    it.
    """

    STARTING = "the arm has not answered since its bridge started"
    DISCONNECTED = "the arm does not answer"
    IDLE = "at rest, not ready"
    TAUT = "at rest, not ready; may slacken the sheet"
    FAULT = "at rest with a latched fault"
    ESTOP = "at rest with a latched e-stop"
    ARMED = "at rest, ready"
    ARMED_TAUT = "at rest, ready; the sheet may be taut"
    CHECKING = "at rest, ready; checks the path to the target"
    CHECKING_TAUT = "like CHECKING; the sheet may be taut"
    FOLLOW = "moves with the sheet's target, after an alignment"
    HOLD = "decelerates or rests because an input is late; stays ready"
    PAUSING = "decelerates; stays ready"
    PAUSING_TAUT = "decelerates; stays ready; the sheet may be taut"
    STOPPING = "decelerates; not ready"
    STOPPING_TAUT = "decelerates; not ready; may slacken the sheet at rest"
    RELAX = "moves its edge towards the other one until the sheet is slack; not ready"


class Event(Enum):
    """The events of an arm's controller, with their descriptions for the documentation."""

    CONNECTION_LOST = "two exchanges without an answer, or an invalid answer"
    CONNECTED = "the arm has answered"
    ANSWER_MISSED = "one exchange without an answer"
    WATCHDOG_TRIPPED = "the arm's own watchdog has stopped it"
    SCENE_CHANGED = "a scene has arrived"
    RESET = "a reset clears e-stop and faults; accepted only at rest"
    ARM = "the operator, or `arming: auto`, arms the arm"
    INTERLOCK = "no target, a fault of the other arm, or the operator forbids motion"
    ISOLATED = "the other arm is silent or e-stopped, or the clocks are not synchronized"
    FAULT = "a fault is latched"
    ESTOP = "an e-stop is latched"
    AT_REST = "the commanded joint angles are constant"
    RELAX = "the arm can start to slacken the sheet"
    RELAX_BLOCKED = "the arm must not, or cannot, slacken the sheet now"
    RELAX_ENDED = "the sheet is slack, or the arm does not obey"
    WAIT_FOR_OTHER = "this arm is ready, the other arm is not"
    TARGET = "both arms are ready, and there is a target"
    PATH_CLEAR = "the path to the target is clear for both arms"
    LATE = "the target or the other arm's state is late"
    IN_TIME = "the target and the other arm's state are in time"


S, E = State, Event

OFFLINE = frozenset({S.STARTING, S.DISCONNECTED})
DISARMED_AT_REST = frozenset({S.IDLE, S.TAUT, S.FAULT, S.ESTOP})
ARMED_AT_REST = frozenset({S.ARMED, S.ARMED_TAUT, S.CHECKING, S.CHECKING_TAUT})
AT_REST = DISARMED_AT_REST | ARMED_AT_REST
TRACKING = frozenset({S.FOLLOW, S.HOLD})
PAUSING_STATES = frozenset({S.PAUSING, S.PAUSING_TAUT})
STOPPING_STATES = frozenset({S.STOPPING, S.STOPPING_TAUT})
DECELERATING = PAUSING_STATES | STOPPING_STATES
RELAXING = frozenset({S.RELAX})

CHECKING_STATES = frozenset({S.CHECKING, S.CHECKING_TAUT})
READY_STATES = ARMED_AT_REST | TRACKING | PAUSING_STATES
"""The states in which the arm is armed and permitted to move."""
MOTION_STATES = TRACKING | DECELERATING | RELAXING
"""The states in which commands may change the joint angles."""

MODES: Mapping[State, ArmMode] = {
    S.STARTING: "starting",
    S.DISCONNECTED: "disconnected",
    S.IDLE: "idle",
    S.TAUT: "idle",
    S.FAULT: "fault",
    S.ESTOP: "estop",
    S.ARMED: "idle",
    S.ARMED_TAUT: "idle",
    S.CHECKING: "hold",
    S.CHECKING_TAUT: "hold",
    S.FOLLOW: "follow",
    S.HOLD: "hold",
    S.PAUSING: "stopping",
    S.PAUSING_TAUT: "stopping",
    S.STOPPING: "stopping",
    S.STOPPING_TAUT: "stopping",
    S.RELAX: "relax",
}
"""The published mode of each state. There is one exception: in the state TAUT, the mode is `fault`
if a fault is latched."""

Row = dict[tuple[State, Event], State | None]


def _row(event: Event, to: Mapping[State, State], *ignored_in: Iterable[State]) -> Row:
    """Return the transitions of one event; raise ValueError if a state occurs twice.

    to: mapping from each state to the next state.
    ignored_in: groups of states that ignore the event.
    """
    ignored = [state for group in ignored_in for state in group]
    row: Row = {(state, event): None for state in ignored} | {
        (state, event): target for state, target in to.items()
    }
    if len(row) != len(ignored) + len(to):
        raise ValueError(f"{event.name}: a state has two transitions")
    return row


_DISARM_AT_REST = {
    S.ARMED: S.IDLE,
    S.ARMED_TAUT: S.TAUT,
    S.CHECKING: S.IDLE,
    S.CHECKING_TAUT: S.TAUT,
}
_STOP = {
    S.FOLLOW: S.STOPPING_TAUT,
    S.HOLD: S.STOPPING_TAUT,
    S.PAUSING: S.STOPPING,
    S.PAUSING_TAUT: S.STOPPING_TAUT,
}
_STOP_WITHOUT_RELAXING = dict.fromkeys(TRACKING | PAUSING_STATES | RELAXING, S.STOPPING) | {
    S.STOPPING_TAUT: S.STOPPING
}
_STOP_AND_NEVER_RELAX = (
    _STOP_WITHOUT_RELAXING | dict.fromkeys(ARMED_AT_REST, S.IDLE) | {S.TAUT: S.IDLE}
)

TRANSITIONS: Mapping[tuple[State, Event], State | None] = {
    **_row(E.CONNECTION_LOST, dict.fromkeys(State, S.DISCONNECTED)),
    **_row(E.CONNECTED, dict.fromkeys(OFFLINE, S.IDLE), AT_REST, MOTION_STATES),
    **_row(E.ANSWER_MISSED, {S.FOLLOW: S.HOLD}, OFFLINE, AT_REST, MOTION_STATES - {S.FOLLOW}),
    **_row(
        E.WATCHDOG_TRIPPED,
        _STOP_AND_NEVER_RELAX,
        OFFLINE,
        {S.IDLE, S.FAULT, S.ESTOP, S.STOPPING},
    ),
    **_row(
        E.SCENE_CHANGED,
        {
            S.ARMED_TAUT: S.ARMED,
            S.CHECKING: S.ARMED,
            S.CHECKING_TAUT: S.ARMED,
            S.FOLLOW: S.PAUSING,
            S.HOLD: S.PAUSING,
            S.PAUSING_TAUT: S.PAUSING,
        },
        OFFLINE,
        DISARMED_AT_REST,
        {S.ARMED, S.PAUSING},
        STOPPING_STATES,
        RELAXING,
    ),
    **_row(
        E.RESET,
        {
            S.FAULT: S.IDLE,
            S.ESTOP: S.IDLE,
            S.FOLLOW: S.PAUSING_TAUT,
            S.HOLD: S.PAUSING_TAUT,
            S.RELAX: S.TAUT,
        },
        OFFLINE,
        {S.IDLE, S.TAUT},
        ARMED_AT_REST,
        DECELERATING,
    ),
    **_row(
        E.ARM,
        {
            S.IDLE: S.ARMED,
            S.TAUT: S.ARMED_TAUT,
            S.STOPPING: S.PAUSING,
            S.STOPPING_TAUT: S.PAUSING_TAUT,
            S.RELAX: S.PAUSING_TAUT,
        },
        OFFLINE,
        {S.FAULT, S.ESTOP},
        ARMED_AT_REST,
        TRACKING,
        PAUSING_STATES,
    ),
    **_row(
        E.INTERLOCK,
        _DISARM_AT_REST | _STOP,
        OFFLINE,
        DISARMED_AT_REST,
        STOPPING_STATES,
        RELAXING,
    ),
    **_row(
        E.ISOLATED,
        _STOP_AND_NEVER_RELAX,
        OFFLINE,
        {S.IDLE, S.FAULT, S.ESTOP, S.STOPPING},
    ),
    **_row(
        E.FAULT,
        _STOP
        | {
            S.IDLE: S.FAULT,
            S.ARMED: S.FAULT,
            S.ARMED_TAUT: S.TAUT,
            S.CHECKING: S.FAULT,
            S.CHECKING_TAUT: S.TAUT,
        },
        OFFLINE,
        {S.TAUT, S.FAULT, S.ESTOP},
        STOPPING_STATES,
        RELAXING,
    ),
    **_row(
        E.ESTOP,
        _STOP_WITHOUT_RELAXING | dict.fromkeys(ARMED_AT_REST | {S.IDLE, S.TAUT, S.FAULT}, S.ESTOP),
        OFFLINE,
        {S.ESTOP, S.STOPPING},
    ),
    **_row(
        E.AT_REST,
        {
            S.PAUSING: S.ARMED,
            S.PAUSING_TAUT: S.ARMED_TAUT,
            S.STOPPING: S.IDLE,
            S.STOPPING_TAUT: S.TAUT,
        },
        OFFLINE,
        AT_REST,
        TRACKING,
        RELAXING,
    ),
    **_row(E.RELAX, {S.TAUT: S.RELAX}, OFFLINE, AT_REST - {S.TAUT}, MOTION_STATES),
    **_row(
        E.RELAX_BLOCKED,
        {S.RELAX: S.STOPPING_TAUT},
        OFFLINE,
        AT_REST,
        TRACKING,
        DECELERATING,
    ),
    **_row(
        E.RELAX_ENDED,
        {S.RELAX: S.STOPPING, S.TAUT: S.IDLE},
        OFFLINE,
        AT_REST - {S.TAUT},
        TRACKING,
        DECELERATING,
    ),
    **_row(
        E.WAIT_FOR_OTHER,
        {
            S.CHECKING: S.ARMED,
            S.CHECKING_TAUT: S.ARMED_TAUT,
            S.FOLLOW: S.PAUSING_TAUT,
            S.HOLD: S.PAUSING_TAUT,
        },
        OFFLINE,
        AT_REST - CHECKING_STATES,
        DECELERATING,
        RELAXING,
    ),
    **_row(
        E.TARGET,
        {S.ARMED: S.CHECKING, S.ARMED_TAUT: S.CHECKING_TAUT},
        OFFLINE,
        DISARMED_AT_REST,
        CHECKING_STATES,
        MOTION_STATES,
    ),
    **_row(
        E.PATH_CLEAR,
        dict.fromkeys(CHECKING_STATES, S.FOLLOW),
        OFFLINE,
        AT_REST - CHECKING_STATES,
        MOTION_STATES,
    ),
    **_row(E.LATE, {S.FOLLOW: S.HOLD}, OFFLINE, AT_REST, MOTION_STATES - {S.FOLLOW}),
    **_row(E.IN_TIME, {S.HOLD: S.FOLLOW}, OFFLINE, AT_REST, MOTION_STATES - {S.HOLD}),
}
"""The next state for each pair of state and event; None if the state ignores the event."""
