"""The states of a scan as people read them: the one table that page, list, terminal and `polysight ask` use.

Each state has a colour, words, the buttons that may be pressed, and phrases that are never shown with it. Words in
braces are filled in: `{folder}`, `{safe}` (rows that are safe), `{all_safe}` (that all are, and how many with gaps),
`{asker}` (who pressed the button), `{now}` (the row being scanned), and what the state is about. `{since}` is filled in
by the page, as the time since the status's `since_s`.
"""

from __future__ import annotations

from typing import Literal

import msgspec

StateLevel = Literal["good", "done", "wait", "warn", "bad"]
Button = Literal["pause", "continue", "stop", "abort", "resume", "again", "repeat", "process"]
"""`again` repeats the start of a scan that could not start; `repeat` plans a new scan with the numbers of this one."""
# Buttons of a scan that runs, and of one that ended before its last row.
BUTTONS_WHILE_RUNNING: tuple[Button, ...] = ("pause", "stop", "abort")
BUTTONS_AFTER_END: tuple[Button, ...] = ("resume", "repeat")


class State(msgspec.Struct, frozen=True):
    """One state: `level` sets colour and sign, `headline` and `detail` say what happens, `why` why, `do` what helps.

    A text is empty if there is nothing to say.
    """

    # Name of the state in `STATES`.
    key: str
    level: StateLevel
    headline: str
    detail: str = ""
    why: str = ""
    do: str = ""
    # Buttons that may be pressed.
    press: tuple[Button, ...] = ()
    # Phrases that the page must not show in this state; its tests look for them.
    never: tuple[str, ...] = ()


# Phrases of `never`, and a remedy that several states have.
_ALL_IS_WELL = "All is well"
_NO_FAULTS = "No faults"
_HAS_FAILED = "has failed"
_RESULT = "Result:"
_UNTIL_RESUMED = "`polysight resume {folder}`"

_TABLE = (
    # --- before the first row ---
    State("empty", "wait", "No scan here yet",
          detail="{folder} contains no scan. This page shows a scan when it begins.",
          do="`polysight scan --out {folder}`", never=(_ALL_IS_WELL, _RESULT)),
    State("starting", "wait", "The scan is starting",
          detail="Its program connects to the rig; this takes some seconds.",
          never=(_ALL_IS_WELL, _NO_FAULTS, _RESULT)),
    State("start_failed", "bad", "The scan could not start", detail="{what}", why="{why}", do="{do}", press=("again",),
          never=(_ALL_IS_WELL, _NO_FAULTS, "No scan here yet", _RESULT)),
    State("homing", "good", "Homing the stage", detail="Rows begin when its position is known.",
          press=BUTTONS_WHILE_RUNNING,
          never=(_RESULT,)),
    # --- rows ---
    State("rows", "good", _ALL_IS_WELL, detail="{now}", press=BUTTONS_WHILE_RUNNING, never=(_RESULT, "starting")),
    State("retake", "warn", "Row {row} is retaken (take {take})", detail="{what}", why="{why}", do="{do}",
          press=BUTTONS_WHILE_RUNNING, never=(_ALL_IS_WELL, _NO_FAULTS, _RESULT)),
    State("after_fault", "warn", "Scanning, after a fault in a row", detail="{what}", why="{why}", do="{do}",
          press=BUTTONS_WHILE_RUNNING, never=(_ALL_IS_WELL, _NO_FAULTS, _RESULT)),
    State("poor", "warn", "Scanning, but the data is poor", detail="{what}", why="{why}", do="{do}",
          press=BUTTONS_WHILE_RUNNING, never=(_ALL_IS_WELL, _RESULT)),
    State("late", "warn", "No row has ended for a while",
          detail="No row has ended for {since}, although the scan program runs.",
          why="It waits for the disk, for processing, or for the stage", do="See its terminal",
          press=BUTTONS_WHILE_RUNNING, never=(_ALL_IS_WELL, _RESULT)),
    State("held", "warn", "The stage is held",
          detail="It is held within a row. After more than 2 s the row is retaken.",
          why="A program other than polysight sent the Pi `Hold`", do="That program sends `Resume`; or abort the scan",
          press=BUTTONS_WHILE_RUNNING, never=(_ALL_IS_WELL, _RESULT)),
    State("pi_silent", "bad", "The Pi is silent", detail="No heartbeat for {since}. The stage stops automatically.",
          why="Network or power of the Pi, or its program ended", do="On the Pi: `systemctl status polysight-pi`",
          press=BUTTONS_WHILE_RUNNING, never=(_ALL_IS_WELL, _RESULT)),
    State("rig_fault", "bad", "The rig has stopped with a fault", detail="{what}", why="{why}", do="{do}",
          press=BUTTONS_WHILE_RUNNING, never=(_ALL_IS_WELL, _NO_FAULTS, _RESULT)),
    # --- requests ---
    State("pausing", "wait", "Pausing after this row", detail="Asked by {asker}. Then the stage does not move.",
          press=("continue", "stop", "abort"), never=(_ALL_IS_WELL, _RESULT)),
    State("paused", "wait", "Paused", detail="Asked by {asker}. {safe} Nothing moves.",
          do="Continue with the button, or `polysight ask {folder} continue`", press=("continue", "stop", "abort"),
          never=(_ALL_IS_WELL, _RESULT)),
    State("stopping", "wait", "Stopping after this row", detail="Asked by {asker}. The scan can be resumed later.",
          press=("abort",), never=(_ALL_IS_WELL, _RESULT)),
    State("aborting", "wait", "Stopping now", detail="Asked by {asker}. The stage stops; the running row is lost.",
          never=(_ALL_IS_WELL, "fault", _RESULT)),
    State("stopped", "wait", "Stopped on request", detail="By {asker}, after a row. {safe}", do=_UNTIL_RESUMED,
          press=BUTTONS_AFTER_END, never=(_ALL_IS_WELL, _HAS_FAILED, "fault in a row", "exit status", _RESULT)),
    State("aborted", "wait", "Aborted on request", detail="By {asker}. {safe}", do=_UNTIL_RESUMED,
          press=BUTTONS_AFTER_END, never=(_ALL_IS_WELL, _HAS_FAILED, "fault in a row", "exit status", _RESULT)),
    # --- ends without being asked ---
    State("failed", "bad", "The scan has failed", detail="{what} {safe}", why="{why}", do="{do}",
          press=BUTTONS_AFTER_END, never=(_ALL_IS_WELL, _RESULT)),
    State("killed", "bad", "The scan program was killed", detail="{safe} The stage stops automatically.",
          why="Its process ended without a message: there was no memory, or somebody killed it", do=_UNTIL_RESUMED,
          press=BUTTONS_AFTER_END, never=(_ALL_IS_WELL, _RESULT)),
    State("frozen", "bad", "The scan program does not respond", detail="No response for {since}; {safe}",
          why="It hangs, its machine is switched off, or its drive is disconnected",
          do="Look at its machine; if the program does not run, `polysight resume {folder}`", press=("abort", "resume"),
          never=(_ALL_IS_WELL, _RESULT)),
    State("resuming", "wait", "The scan is being resumed", detail="{safe} Its program connects to the rig.",
          never=(_ALL_IS_WELL, _HAS_FAILED, _RESULT)),
    # --- the end ---
    State("homing_again", "good", "Homing the stage again", detail="Every row is recorded; this measures lost steps.",
          press=("abort",), never=("Rows begin", _RESULT)),
    State("finishing", "good", "The scan is finishing", detail="Every row is recorded.", never=("Rows begin", _RESULT)),
    State("materials", "wait", "Materials are being computed",
          detail="{all_safe} The result is shown when this has ended.", never=(_RESULT, "not processed")),
    State("finished", "done", "The scan is finished", detail="{all_safe} It was not processed.",
          press=("process", "repeat"), never=(_RESULT,)),
    State("unprocessed", "bad", "Every row is safe, but processing failed", detail="{what}", why="{why}", do="{do}",
          press=("process", "repeat"), never=(_ALL_IS_WELL, _RESULT)),
    State("result_good", "done", "The scan is finished", detail="{all_safe}", press=("repeat",),
          never=("not processed",)),
    State("result_care", "warn", "Finished: use the result with care", detail="{all_safe}", press=("repeat",),
          never=("not processed",)),
    State("result_none", "bad", "Finished without a result", detail="{all_safe}", press=("repeat",),
          never=("not processed",)),
    State("processing", "wait", "Processing again",
          detail="The earlier result is shown until this has ended."),
    # --- what cannot be read ---
    State("unreadable", "bad", "This scan cannot be shown", detail="{what}",
          why="It was written by another release, or is damaged", do="`polysight validate {folder}`",
          never=(_ALL_IS_WELL, _RESULT)),
    State("folder_gone", "bad", "The scan's folder no longer exists", detail="{folder} existed before.",
          why="It was moved, renamed or deleted, or its drive is disconnected", do="Look for it in the list of scans",
          never=(_ALL_IS_WELL, "disk is full")),
    # --- the page itself, which keeps these words for when it is alone ---
    State("offline", "wait", "No connection to the server",
          detail="Reconnecting. The scan continues without this page.",
          why="`polysight serve` was ended, or the network is interrupted",
          do="In a shell on the host: `polysight ask {folder} abort`; the emergency stop stops the stage",
          never=(_ALL_IS_WELL,)),
    State("server_frozen", "wait", "The server does not respond", detail="The scan continues without it.",
          why="Its machine is very busy, or its drive is disconnected",
          do="In a shell on the host: `polysight ask {folder} abort`; the emergency stop stops the stage",
          never=(_ALL_IS_WELL,)),
)  # fmt: skip
STATES = {state.key: state for state in _TABLE}

BADGES: dict[str, tuple[str, StateLevel]] = {
    "running": ("is being scanned", "wait"),
    "paused": ("paused", "wait"),
    "finished": ("finished", "good"),
    "stopped": ("stopped on request", "wait"),
    "failed": ("failed", "bad"),
    "lost": ("killed", "bad"),
    "frozen": ("does not respond", "bad"),
    "begun": ("not begun", "warn"),
    "products": ("products only", "good"),
    "damaged": ("damaged", "bad"),
    "silent": ("folder does not answer", "bad"),
}
"""Words and colours of lists, by the state of a :class:`polysight.catalogue.Summary`."""
