"""Draw the sheets of docs/how-to/wiring.md, one connection a sheet: `python docs/images/draw_wiring.py`.

Each sheet is a list of wires from a terminal on the left to a terminal on the right, 460 pixels wide: readable on a
phone and at A4. The terminals are data, so that a sheet is changed in one line.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).parent
# Pixels: width of a sheet, height of a wire's line, place of the first line, left edges of both boxes and their width.
WIDTH = 460
ROW = 34
TOP = 78
LEFT = 8
RIGHT = 312
BOX = 140
# Colour of each kind of wire.
COLOURS = {"signal": "#1f6fb2", "pulse": "#c0392b", "power": "#c46a00", "ground": "#222222", "motor": "#69498a"}


class Wire(NamedTuple):
    """One wire between two terminals; `kind` is one of `COLOURS`.

    `part` is what sits in it: a value, `NC` (a contact drawn closed) or nothing.
    """

    left: str
    right: str
    kind: str
    part: str = ""


class Sheet(NamedTuple):
    """A connection between two things, `left` and `right`; `name` is that of the file, `notes` stand below it."""

    name: str
    title: str
    left: str
    right: str
    wires: tuple[Wire, ...]
    notes: tuple[str, ...] = ()


def _driver(name: str, pul: str, direction: str) -> Sheet:
    """Return the sheet of a motor driver, with the UNO's pins of its pulse and direction inputs."""
    return Sheet(
        f"wiring-driver-{name}",
        f"Motor driver {name} (DM542), common cathode",
        "Arduino UNO",
        f"driver {name}",
        (
            Wire(pul, "PUL+", "signal"),
            Wire("GND", "PUL-", "ground"),
            Wire(direction, "DIR+", "signal"),
            Wire("GND", "DIR-", "ground"),
            Wire("5V", "ENA+", "power"),
            Wire("ULN2003A 16 (1C)", "ENA-", "signal"),
            Wire("contactor 6/T3", "+Vdc", "power"),
            Wire("24 V supply -V", "GND (power)", "ground"),
            Wire("motor coil A", "A+ A-", "motor"),
            Wire("motor coil B", "B+ B-", "motor"),
        ),
        (
            "SW1 ON, SW2 ON, SW3 OFF (2.84 A), SW4 OFF (half at rest),",
            "SW5 OFF, SW6 OFF, SW7 ON, SW8 ON (1600 a turn).",
        ),
    )


SHEETS = (
    _driver("x", "D5", "D10"),
    _driver("left", "D3", "D8"),
    _driver("right", "D4", "D9"),
    Sheet(
        "wiring-enable", "Enable and brake: ULN2003A", "UNO, supply", "ULN2003A",
        (
            Wire("D7 (LOW = on)", "1 (1B in)", "signal"),
            Wire("ENA- of 3 drivers", "16 (1C out)", "signal"),
            Wire("D12 (HIGH = release)", "2 (2B in)", "signal"),
            Wire("brake coil -", "15 (2C out)", "power"),
            Wire("contactor 6/T3", "9 (COM)", "power"),
            Wire("contactor 6/T3", "brake coil +", "power"),
            Wire("supply -V, UNO GND", "8 (E)", "ground"),
        ),
        (
            "Brake: closed without current. It closes with the",
            "emergency stop, after a reset, with motors off.",
            "Above 0.4 A: a relay with its own diode instead.",
            "UNO in reset or unplugged: motors hold, brake closed.",
        ),
    ),
    Sheet(
        "wiring-switches", "Switches, drawn at rest: contacts CLOSED", "Arduino UNO", "UNO GND",
        (
            Wire("A0", "x limit 11-12", "signal", "NC"),
            Wire("A1", "y limit 11-12", "signal", "NC"),
            Wire("A2", "e-stop 11-12", "signal", "NC"),
        ),
        ("A pressed switch opens, and so does a broken wire.", "Twisted with ground; 100 nF from each input to GND."),
    ),
    Sheet(
        "wiring-mains", "Mains side of the drivers' supply", "inlet (IEC C14)", "LRS-150-24",
        (
            Wire("L, fuse, switch", "1 (AC/L)", "power", "T3.15A"),
            Wire("N, switch", "2 (AC/N)", "power"),
            Wire("PE, no switch", "3 (earth)", "ground"),
            Wire("PE", "metal frame", "ground"),
        ),
        (
            "Voltage selector of the supply FIRST: 115 or 230 V.",
            "Fuse: T3.15A at 230 V, T5A at 115 V.",
            "Covered terminals, a residual current device in the",
            "socket; by who may work on mains where you are.",
        ),
    ),
    Sheet(
        "wiring-power", "Drivers' supply and emergency stop", "from", "to",
        (
            Wire("supply 6 (+V)", "contactor 1/L1", "power", "T6.3A"),
            Wire("contactor 2/T1", "contactor 3/L2", "power"),
            Wire("contactor 4/T2", "contactor 5/L3", "power"),
            Wire("contactor 6/T3", "3 x +Vdc, brake +", "power"),
            Wire("behind the fuse", "e-stop 21-22", "power", "NC"),
            Wire("e-stop 22", "contactor A1", "power"),
            Wire("supply 4 (-V)", "contactor A2", "ground"),
            Wire("supply 4 (-V)", "3 x GND (power)", "ground"),
            Wire("supply 5 (-V)", "UNO GND (one point)", "ground"),
        ),
        (
            "Three contacts in series: they break direct current.",
            "NC: second block of the emergency stop.",
            "Logic (Pi, UNO) has its own supply and stays on.",
        ),
    ),
    Sheet(
        "wiring-trigger", "Stage trigger", "Arduino UNO", "Raspberry Pi",
        (
            Wire("D2, 5 V", "GPIO 26, pin 37", "signal", "10 k"),
            Wire("GND", "GPIO 26, pin 37", "ground", "20 k"),
            Wire("GND", "GND, pin 39", "ground"),
            Wire("USB", "USB", "motor"),
        ),
    ),
    Sheet(
        "wiring-one-shot", "One-shot 74LVC1G123", "Raspberry Pi", "74LVC1G123",
        (
            Wire("GPIO 22, pin 15", "2 (B)", "pulse"),
            Wire("GND, pin 14", "2 (B)", "ground", "10 k"),
            Wire("GND, pin 14", "1 (A)", "ground"),
            Wire("3.3 V, pin 17", "3 (CLR)", "power"),
            Wire("3.3 V, pin 17", "8 (VCC)", "power"),
            Wire("GND, pin 14", "4 (GND)", "ground"),
            Wire("3.3 V", "7 (Rext/Cext)", "power", "10 k"),
            Wire("6 (Cext)", "7 (Rext/Cext)", "signal", "100 pF"),
            Wire("buffer 1 (CLKIN)", "5 (Q), 1 us", "pulse"),
        ),
        ("100 nF from VCC to GND at the chip.", "Left out with 'spi': MOSI (pin 19) to CLKIN."),
    ),
    Sheet(
        "wiring-buffer", "Clock buffer CDCLVC1104", "CDCLVC1104", "to",
        (
            Wire("1 (CLKIN)", "one-shot 5 (Q)", "pulse"),
            Wire("2 (1G)", "3.3 V, pin 17", "power"),
            Wire("6 (VDD), 100 nF", "3.3 V, pin 17", "power"),
            Wire("4 (GND)", "GND, pin 20", "ground"),
            Wire("3 (Y0)", "LS: J5 pin 9", "pulse", "33"),
            Wire("8 (Y1)", "RH: J5 pin 9", "pulse", "33"),
            Wire("5 (Y2)", "RV: J5 pin 9", "pulse", "33"),
            Wire("7 (Y3, return)", "Pi GPIO 23, pin 16", "pulse", "33"),
            Wire("GND of each cable", "board's GND", "ground"),
        ),
        ("Three cables of one length. Remove R62 on each board.", "With 'spi' the return goes to MISO (pin 21)."),
    ),
)  # fmt: skip


def _text(x: float, y: float, text: str, size: float = 13, anchor: str = "start", bold: bool = False) -> str:
    """Return a text element; `anchor` says which end of the text is at x."""
    weight = ' font-weight="bold"' if bold else ""
    text = text.replace("&", "&amp;").replace("<", "&lt;")
    return f'<text x="{x}" y="{y}" font-size="{size}" text-anchor="{anchor}"{weight}>{text}</text>'


def draw(sheet: Sheet) -> str:
    """Return the sheet as SVG."""
    bottom = TOP + ROW * len(sheet.wires)
    height = bottom + 20 + 22 * len(sheet.notes)
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{height}" viewBox="0 0 {WIDTH} {height}"'
        ' font-family="DejaVu Sans, Helvetica, Arial, sans-serif">',
        f"<title>{sheet.title}</title>",
        f'<rect width="{WIDTH}" height="{height}" fill="#ffffff"/>',
        _text(WIDTH / 2, 24, sheet.title, 16, "middle", bold=True),
    ]
    for x, name in ((LEFT, sheet.left), (RIGHT, sheet.right)):
        out.append(
            f'<rect x="{x}" y="40" width="{BOX}" height="{bottom - 32}" rx="6" fill="#f4f6f8" stroke="#3b4754"/>'
        )
        out.append(_text(x + BOX / 2, 60, name, 14, "middle", bold=True))
    for i, wire in enumerate(sheet.wires):
        y = TOP + ROW * i + 12
        colour = COLOURS[wire.kind]
        dash = ' stroke-dasharray="7 4"' if wire.kind == "ground" else ""
        stroke = f'stroke="{colour}" stroke-width="2.4" fill="none"'
        middle = (LEFT + BOX + RIGHT) / 2
        out.append(f'<path d="M{LEFT + BOX} {y} H{RIGHT}" {stroke}{dash}/>')
        if wire.part == "NC":
            out.append(f'<circle cx="{middle - 16}" cy="{y}" r="4" fill="{colour}"/>')
            out.append(f'<circle cx="{middle + 16}" cy="{y}" r="4" fill="{colour}"/>')
            out.append(_text(middle, y - 8, "NC, closed", 12, "middle"))
        elif wire.part:
            out.append(f'<rect x="{middle - 26}" y="{y - 10}" width="52" height="20" fill="#fff7e0" stroke="#8a6d1b"/>')
            out.append(_text(middle, y + 5, wire.part, 12.5, "middle"))
        out.append(_text(LEFT + BOX - 6, y + 5, wire.left, 12, "end"))
        out.append(_text(RIGHT + 6, y + 5, wire.right, 12))
    for k, note in enumerate(sheet.notes):
        out.append(_text(LEFT, bottom + 30 + 22 * k, note, 14))
    return "\n".join([*out, "</svg>", ""])


if __name__ == "__main__":
    for sheet_to_draw in SHEETS:
        (HERE / f"{sheet_to_draw.name}.svg").write_text(draw(sheet_to_draw), encoding="utf-8")
