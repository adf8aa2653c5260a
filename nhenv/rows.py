"""How many environments take a step together, as source that generated kernels take in whole.

Rows are environments. Their numbers lie in blocks of ROWS, one stretch of STRIDE places for each field, so that loops
over the rows of a block become vector code. A block has what lasts (`p`: states, targets, steps, whether the episode
is over); a scratch area as large as the first cache has what a step needs on its way (`w`).

Free flight is integrated for all rows at once. Rows that meet a stop are few, but not rare: they are gathered from all
blocks into a spare one (`v`, `spare`), where they go through an impact together, in the very arithmetic of
`mechanics.compiler.stops`. So are, into another, those whose flight is not right, to go on in shorter ones. What does
not fit these schemes is left to `hold`, row by row.

Every function here is plain Python over arrays and runs compiled or not. Names in the section below are stand-ins for
what the generated module defines itself.
"""

from typing import Any

from numpy import empty, int64, nan, uint64, zeros

from mechanics.compiler.stops import hold
from nhenv.scene import DIVERGED, RUNNING, TERMINATED

__all__ = ["EVENTFUL", "SOURCES", "begin_rows", "look_rows", "step_rows"]

Array = Any  # NumPy array, or Numba's view of one
Count = Any  # whole number, Python's or NumPy's

ROWS = STRIDE = SUBSTEPS = JOINTS = EVENTS = KINDS = 0
NEXT_STEP, SAME_STEP, DISABLED = 0.0, 1.0, 2.0
# Places of the first row: of fields that last, of scratch fields, and of the numbers that hold for all rows.
STATE = STEPS = OVER = 0
X = CONTROL = BAD = HIT = STATUS = 0
N_STATES = N_CONTROLS = N_OBSERVATIONS = 0
DT = MAX_STEPS = MODE = NOTHING = 0


# Loops over the rows of a block, which `nhenv.rows_kernel` writes: p is the block, w its scratch area.
load_rows: Any = None  # (w, count, actions): clip the actions, zero those that are not numbers
prepare_rows: Any = None  # (p, w, count, numbers) -> count: settle joints on stops; how many states that changed
advance_rows: Any = None  # (p, w, count, numbers): move for the row's own time, once for each substep; observe
see_rows: Any = None  # (p, w, count, numbers): observe
screen_rows: Any = None  # (p, w, count, numbers) -> count: which may have met a stop, or are not right
finish_rows: Any = None  # (p, w, count, numbers) -> count: judge, and keep the state; how many have something to report
inform_rows: Any = None  # (p, w, count, numbers, judged, start): write what was judged, one by one
emit_rows: Any = None  # (w, count, observations, rewards): write what the step returns
take_rows: Any = None  # (p, w, count, rows, spare, v, held): copy rows into the spare block
give_rows: Any = None  # (v, count, rows, observations, rewards): write what their step returns
put_rows: Any = None  # (spare, count, rows, blocks): copy them back
begin_flights: Any = None  # (p, w, count, numbers): all of the hold is before each row
depart_rows: Any = None  # (p, w, count, numbers): settle joints on stops; the time of the next flight
arrive_rows: Any = None  # (p, w, count, numbers) -> count: keep the state if it is right; how many are not through
end_flights: Any = None  # (p, w, count, numbers) -> count: which did not get through like this
bracket_rows: Any = None  # (p, w, count, numbers) -> count: begin the search for the impact
rewind_rows: Any = None  # (p, w, count, numbers): go back to the beginning of the flight, for the time to be tried
refine_rows: Any = None  # (p, w, count, numbers) -> count: a better time; how many need another
land_rows: Any = None  # (p, w, count, numbers): stop the joint where it is, for the time that is left
check_rows: Any = None  # (p, w, count, numbers) -> count: which did not fit this scheme
# Of single rows.
start_row: Any = None  # (p, j, streams, row, numbers, given): begin an episode
look_row: Any = None  # (p, j, numbers, observation): observe
held_numbers: Any = None  # (p, j, numbers, limits) -> constants; write the stops to `limits`


MAX_SWEEPS = 12  # Halley's method from a cubic needs two
MAX_ROUNDS = 16  # more are not worth a place for every row of the block

# What comes of a row's free flight: it may have met a stop; it is not right.
STOPPED, LATE = 1.0, 2.0

# What is sought in a flight that may have met a stop: where it crosses the stop, where it turns; or one flight is left.
CROSSING, TURN, LAST = 1.0, 2.0, 3.0

# What happened in a step, as bits.
DONE, BAD_ROW, DIVERGED_ROW, RESET = 1, 2, 4, 8

CONSTANTS = (
    "MAX_SWEEPS",
    "MAX_ROUNDS",
    "STOPPED",
    "LATE",
    "CROSSING",
    "TURN",
    "LAST",
    "DONE",
    "BAD_ROW",
    "DIVERGED_ROW",
    "RESET",
)


def step_rows(
    blocks: Array,
    streams: Array,
    scratch: Array,
    numbers: Array,
    actions: Array,
    observations: Array,
    rewards: Array,
    terminated: Array,
    truncated: Array,
    finals: Array,
    judged: Array,
    flags: Array,
    first: int,
    last: int,
) -> Count:
    """Step the rows of some blocks, and start the episodes that are due; return what happened, as bits."""
    w, own = scratch[0], empty(ROWS + 1, uint64)  # and the rows of a block
    held, places = zeros(2, int64), empty((2, ROWS), uint64)  # of each spare block: its size, the row of each place
    # Plain integers, lest Numba compile everything once more for the constant 0.
    events, size = int64(0), len(rewards)
    for b in range(first, last + 1):  # one round more, for what is left in the spare blocks
        p, start = blocks[min(b, last - 1)], b * ROWS
        count = min(ROWS, size - start) if b < last else int64(0)
        end, hits = start + count, int64(0)
        if count > 0:
            load_rows(w, count, actions[start:end])
            if prepare_rows(p, w, count, numbers) > 0:
                see_rows(p, w, count, numbers)
            for _ in range(SUBSTEPS):
                advance_rows(p, w, count, numbers)
            hits = screen_rows(p, w, count, numbers)
        for kind in range(KINDS):
            v, spare = scratch[1 + 2 * kind], scratch[2 + 2 * kind]
            if held[kind] > 0 and (held[kind] + hits > ROWS or b == last):
                events |= from_event_to_event(
                    blocks, streams, spare, v, held[kind], kind == 1, places[kind], numbers, observations, rewards,
                    terminated, truncated, finals, judged, flags,
                )  # fmt: skip
                held[kind] = 0
            if hits > 0:
                event = LATE if kind == 1 else STOPPED
                held[kind] = gather_rows(p, w, count, event, start, spare, v, held[kind], places[kind], own)
        if count > 0:
            busy = finish_rows(p, w, count, numbers)
            emit_rows(w, count, observations[start:end], rewards[start:end])
            if judged.shape[1] > 0:
                inform_rows(p, w, count, numbers, judged, start)
            if busy > 0:
                for j in range(count):
                    own[j] = start + j
                events |= end_episodes(
                    p, w, count, own, streams, numbers, observations, rewards, terminated, truncated, finals, flags
                )
    return events


def gather_rows(
    p: Array,
    w: Array,
    count: Count,
    event: float,
    start: Count,
    spare: Array,
    v: Array,
    held: Count,
    places: Array,
    own: Array,
) -> Count:
    """Append the rows of an event to the spare block that it has, with their state as if there were none."""
    found = int64(0)
    for j in range(count):  # without a branch, which would be predicted wrongly for most of them
        own[found] = j
        found += 1 if w[HIT + j] == event else 0
    take_rows(p, w, found, own, spare, v, held)
    for i in range(found):
        places[held + i] = uint64(start) + own[i]
    return held + found


def from_event_to_event(
    blocks: Array,
    streams: Array,
    spare: Array,
    v: Array,
    count: Count,
    late: bool,
    places: Array,
    numbers: Array,
    observations: Array,
    rewards: Array,
    terminated: Array,
    truncated: Array,
    finals: Array,
    judged: Array,
    flags: Array,
) -> Count:
    """Do again the step of the rows in the spare block, from event to event, and put them back."""
    irregular = count
    if KINDS == 2 and late:
        begin_flights(spare, v, count, numbers)
        for _ in range(MAX_ROUNDS):
            depart_rows(spare, v, count, numbers)
            for _ in range(SUBSTEPS):
                advance_rows(spare, v, count, numbers)
            if arrive_rows(spare, v, count, numbers) == 0:
                break
        irregular = end_flights(spare, v, count, numbers)
    elif JOINTS == 1:
        if bracket_rows(spare, v, count, numbers) > 0:
            for _ in range(MAX_SWEEPS):
                rewind_rows(spare, v, count, numbers)
                for _ in range(SUBSTEPS):
                    advance_rows(spare, v, count, numbers)
                if refine_rows(spare, v, count, numbers) == 0:
                    break
            land_rows(spare, v, count, numbers)
            for _ in range(SUBSTEPS):
                advance_rows(spare, v, count, numbers)
        irregular = check_rows(spare, v, count, numbers)
    if irregular > 0:
        state, control, new = empty(N_STATES), empty(N_CONTROLS), empty(N_STATES)
        limits, free, work, hits = empty(JOINTS), empty(JOINTS), empty(2 * JOINTS), empty(JOINTS)
        for j in range(count):
            if v[HIT + j] != 0.0:
                for i in range(N_STATES):
                    state[i] = spare[STATE + i * STRIDE + j]
                for i in range(N_CONTROLS):
                    control[i] = v[CONTROL + i * STRIDE + j]
                k = held_numbers(spare, j, numbers, limits)
                held = hold(numbers[DT], state, control, k, limits, free, work, hits, new)
                for i in range(N_STATES):
                    v[X + i * STRIDE + j] = state[i] if held else nan
    if irregular > 0 or late:
        see_rows(spare, v, count, numbers)
    for j in range(count):
        v[HIT + j] = 0.0
    busy = finish_rows(spare, v, count, numbers)
    give_rows(v, count, places, observations, rewards)
    if judged.shape[1] > 0:
        values = empty((judged.shape[0], count))
        inform_rows(spare, v, count, numbers, values, 0)
        for j in range(count):
            for i in range(judged.shape[0]):
                judged[i, places[j]] = values[i, j]
    events = 0
    if busy > 0:
        events = end_episodes(
            spare, v, count, places, streams, numbers, observations, rewards, terminated, truncated, finals, flags
        )
    put_rows(spare, count, places, blocks)
    return events


def end_episodes(
    p: Array,
    w: Array,
    count: Count,
    rows: Array,
    streams: Array,
    numbers: Array,
    observations: Array,
    rewards: Array,
    terminated: Array,
    truncated: Array,
    finals: Array,
    flags: Array,
) -> Count:
    """Report the episodes of a block that are over and start those that are due, as the mode of autoreset says."""
    events = 0
    for j in range(count):
        if EVENTS and w[HIT + j] != 0.0:
            continue  # its step is not done yet
        row = rows[j]
        if p[OVER + j] != 0.0 and numbers[MODE] == NEXT_STEP:
            start_row(p, j, streams, row, numbers, numbers[NOTHING:])
            look_row(p, j, numbers, observations[row])
            rewards[row] = 0.0
            events |= RESET
            continue
        status = w[STATUS + j]
        if w[BAD + j] != RUNNING:
            flags[row] |= BAD_ROW
            events |= BAD_ROW
        if status == DIVERGED:
            look_row(p, j, numbers, observations[row])
            flags[row] |= DIVERGED_ROW
            events |= DIVERGED_ROW
        terminated[row] = status == DIVERGED or status == TERMINATED
        truncated[row] = p[STEPS + j] >= numbers[MAX_STEPS]
        if terminated[row] or truncated[row]:
            events |= DONE
            p[OVER + j] = 1.0
            if numbers[MODE] == SAME_STEP:
                for i in range(N_OBSERVATIONS):
                    finals[row, i] = observations[row, i]
                start_row(p, j, streams, row, numbers, numbers[NOTHING:])
                look_row(p, j, numbers, observations[row])
    return events


def begin_rows(blocks: Array, streams: Array, numbers: Array, mask: Array, given: Array) -> None:
    """Start an episode in each row of `mask`, with the targets in `given` (N, targets) unless they are not numbers."""
    for row in range(len(mask)):
        if mask[row]:
            start_row(blocks[row // ROWS], row % ROWS, streams, row, numbers, given[row])


def look_rows(blocks: Array, numbers: Array, observations: Array) -> None:
    """Observe every row."""
    for row in range(len(observations)):
        look_row(blocks[row // ROWS], row % ROWS, numbers, observations[row])


# In the order in which a module that contains them defines them.
EVENTFUL = (gather_rows, from_event_to_event)
SOURCES = (end_episodes, *EVENTFUL, step_rows, begin_rows, look_rows)
