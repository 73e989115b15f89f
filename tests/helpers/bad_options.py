"""Bad values of the options of every verb, as a table: what is run, and which option and value the message must name."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

NO_NUMBERS = ("", "abc", "1e", "0x10", "1,5", "5 mm", "--", "1e5e5")
NOT_FINITE = ("nan", "inf", "-inf", "1e999", "1" + "0" * 400)
NOT_POSITIVE = ("0", "-0.0", "-1", "-1e-300", "-1e308")
EXTREME = ("1e308", "1e-300", "1e30", "5e-324")
NO_COUNTS = ("", "abc", "1e", "5 mm", "2.5", "nan", "inf", "0", "-1", "-" + "9" * 30)
LENGTH = (*NO_NUMBERS, *NOT_FINITE, *NOT_POSITIVE, *EXTREME)
NO_DRIFT = ("0", "-0.0", "1e-300", "5e-324")  # of a sensor: states that there is none


@dataclass(frozen=True)
class BadOption:
    """A command that must be refused.

    Attributes
    ----------
    verb : str
        The verb.
    arguments : tuple of str
        Operands and the options that it needs, with names of files as `{name}`.
    option : str
        The option at fault.
    values : tuple of str
        Its values; the message must name the option, and one of them.
    """

    verb: str
    arguments: tuple[str, ...]
    option: str
    values: tuple[str, ...]

    @property
    def command(self) -> list[str]:
        """Words of the command line."""
        given = [f"{self.option}={self.values[0]}"] if len(self.values) == 1 else [self.option, *self.values]
        return [self.verb, *self.arguments, *given]


TRACK = ("{scan}", "{scan2}")
TABLES = ("{table}", "{table2}")
SIZE = ("--size-mm", "60", "60", "60")
DIAMETER = ("--diameter-mm", "2")
BODY = ("{solid}", "--path", "{blade}")
SHEET = ("{sheet}", "--path", "{tip}")
VIEWS = ("--cc", "{cc}", "--mlo", "{mlo}", "--point-cc", "40,5")
FIELD = ("{field}", "--zones", "{labels}", "--known", "label 2=10 kPa")
NUMBERS: tuple[tuple[str, tuple[str, ...], str, tuple[str, ...]], ...] = (
    # 0 lets naibu choose the size of the elements
    ("identify", ("{press}",), "--element-size-mm", tuple(v for v in LENGTH if v not in ("0", "-0.0"))),
    ("compare", ("{press}",), "--element-size-mm", tuple(v for v in LENGTH if v not in ("0", "-0.0"))),
    ("predict", ("{model}", "{press}", "--state", "pressed"), "--height-mm", LENGTH),
    ("decode-forces", ("{table}", "{table2}"), "--noise-share", LENGTH),
    ("decode-forces", ("{table}", "{table2}"), "--free-rows", tuple(v for v in NO_COUNTS if v != "0")),
    ("track", TRACK, "--diameter-mm", LENGTH),
    ("track", (*TRACK, *DIAMETER), "--thickness-mm", LENGTH),
    ("track", (*TRACK, *DIAMETER), "--count", NO_COUNTS),
    ("track", (*TRACK, *DIAMETER, *SIZE, "--loading", "bar", "--bar-axis", "x"), "--bar-width-mm", LENGTH),
    ("track-sequence", ("{frames}", *DIAMETER), "--pixel-mm", LENGTH),
    ("track-sequence", ("{frames}", "--pixel-mm", "1"), "--diameter-mm", LENGTH),
    ("track-sequence", ("{frames}", "--pixel-mm", "1", *DIAMETER), "--frame-rate-hz", LENGTH),
    ("track-sequence", ("{frames}", "--pixel-mm", "1", *DIAMETER), "--count", NO_COUNTS),
    ("import", (*TABLES, *SIZE), "--spacing-mm", LENGTH),
    ("import", (*TABLES, *SIZE), "--xy-step-mm", LENGTH),
    ("import", (*TABLES, *SIZE), "--z-step-mm", LENGTH),
    ("import", (*TABLES, *SIZE, "--loading", "bar", "--bar-axis", "x"), "--bar-width-mm", LENGTH),
    ("cut", BODY, "--distance-mm", LENGTH),
    ("cut", BODY, "--young-modulus-kpa", LENGTH),
    ("cut", SHEET, "--distance-mm", LENGTH),
    ("cut", SHEET, "--reach-mm", LENGTH),
    ("cut", SHEET, "--unit-mm", LENGTH),
    ("mammography", (*VIEWS, "--angle-deg", "45"), "--thickness-mm", tuple(v for v in LENGTH if v != "1,5")),  # two plates
    ("mammography", (*VIEWS, "--thickness-mm", "50"), "--angle-deg", LENGTH),
    ("mammography", (*VIEWS, "--thickness-mm", "50", "--angle-deg", "45"), "--draws", NO_COUNTS),
    ("identify", FIELD, "--element-size-mm", tuple(v for v in LENGTH if v not in ("0", "-0.0"))),
    ("live", ("{solid}", "--no-browser"), "--young-modulus-kpa", LENGTH),
    ("reproduce", ("ch3",), "--seed", tuple(v for v in NO_COUNTS if v != "0")),
    ("simulate", ("{study}",), "--checkpoint-every", NO_COUNTS),
    ("calibrate", ("{study}", "--shapes", "{cloud}"), "--point-sd-mm", LENGTH),
    ("calibrate", ("{study}", "--forces", "{sensor}"), "--force-sd-mn", LENGTH),
    ("calibrate", ("{study}", "--forces", "{sensor}"), "--force-drift-mn-per-s", tuple(v for v in LENGTH if v not in NO_DRIFT)),
    ("calibrate", ("{study}", "--shapes", "{cloud}"), "--max-runs", NO_COUNTS),
    ("calibrate", ("{study}", "--shapes", "{cloud}"), "--threads", NO_COUNTS),
)
TRIPLES = (
    ("sense", ("{scan}", "{scan2}"), "--spacing-mm"),
    ("compare-methods", ("{scan}", "{scan2}"), "--spacing-mm"),
    ("track", (*TRACK, *DIAMETER), "--spacing-mm"),
    ("track", (*TRACK, *DIAMETER), "--size-mm"),
    ("import", TABLES, "--size-mm"),
)
CHOICES = (
    ("identify", ("{press}",), "--law"), ("identify", ("{press}",), "--contact"), ("identify", ("{press}",), "--joined"),
    ("identify", ("{press}",), "--pixel-scale"), ("compare", ("{press}",), "--law"), ("compare", ("{press}",), "--contact"),
    ("compare", ("{press}",), "--joined"), ("sense", TRACK, "--method"), ("compare-methods", TRACK, "--method"),
    ("track", (*TRACK, *DIAMETER), "--polarity"), ("track", (*TRACK, *DIAMETER, *SIZE), "--shape"),
    ("track", (*TRACK, *DIAMETER, *SIZE), "--loading"), ("track-sequence", ("{frames}", "--pixel-mm", "1", *DIAMETER), "--polarity"),
    ("import", (*TABLES, *SIZE), "--shape"), ("import", (*TABLES, *SIZE), "--loading"), ("import", (*TABLES, *SIZE), "--unit"),
    ("import", (*TABLES, *SIZE, "--loading", "side_plates"), "--bar-axis"),
    ("simulate", ("{study}",), "--device"), ("calibrate", ("{study}", "--shapes", "{cloud}"), "--groups"),
    ("calibrate", ("{study}", "--shapes", "{cloud}"), "--friction"), ("calibrate", ("{study}", "--shapes", "{cloud}"), "--method"),
)  # fmt: skip
NO_CHOICES = ("", "nan", "Neo_Hookean ", "<script>", "../..", "é" * 50)
NO_KNOWN = (
    "", "=", "=222 kPa", "firm=", "firm=abc", "firm=0 kPa", "firm=-5 kPa", "firm=nan kPa", "firm=inf kPa", "firm=1e308 kPa",
    "firm=1e308 MPa", "firm=1e-300 kPa", "firm=1e-320 Pa", "firm=5 psi", "firm=5 kpa", "firm=5,5 kPa", "firm=1..2 kPa", "nosuch=5 kPa",
    "nosuch", "firm=5 kPa=6", "<script>=5 kPa", "firm=" + "9" * 400, "firm=1e", "firm=--5 kPa", "FIRM=5 kPa", "firm =",
)  # fmt: skip
NO_STATES = ("", "/", "press/", "press/nosuch", "other/pressed", "press/initial", "press/pressed/pressed", "<script>", "\u00e9")
NO_LAYERS = (
    "", "=", "a", "a=", "a=0", "a=0..", "a=..30", "=0..30", "a=0.30", "a=30..0", "a=5..5", "a=nan..30", "a=0..inf", "a=-1..30",
    "a=0..1e308", "a=x..y", "a=0..-5", "a=0..30mm",
)  # fmt: skip
NO_HEIGHTS = (
    "", "=", "45", "pressed", "pressed=", "=45", "pressed=x", "pressed=0", "pressed=-5", "pressed=nan", "pressed=inf", "pressed=1e308",
    "pressed=1e-300", "pressed=45mm", "nosuch=45",
)  # fmt: skip
NO_VERTICALS = ("", "w", "-", "--", "0,0,0", "0,1", "1,2,3,4", "nan,0,1", "inf,0,1", "0;0;1", "found?", "Found", "0.1,a,1", "<script>")
TEXTS = (
    ("import", (*TABLES, *SIZE), "--vertical", NO_VERTICALS),
    ("calibrate", ("{study}",), "--shapes", ("nosuch.csv", "nan={cloud}", "-1=shape.ply", "soon=shape.ply", "<script>")),
    ("calibrate", ("{study}",), "--forces", ("nosuch.csv", "nosuch=nosuch.csv", "<script>")),
    ("identify", ("{press}",), "--known", NO_KNOWN),
    ("compare", ("{press}",), "--known", NO_KNOWN),
    ("identify", ("{press}",), "--state", NO_STATES),
    ("predict", ("{model}", "{press}"), "--state", ("nosuch", "initial", "press/pressed", "<script>", "\u00e9")),
    ("import", (*TABLES, *SIZE), "--layer", NO_LAYERS),
    ("track", (*TRACK, *DIAMETER, *SIZE), "--layer", NO_LAYERS),
    ("import", (*TABLES, *SIZE), "--stated-mm", NO_HEIGHTS),
    ("track", (*TRACK, *DIAMETER, *SIZE), "--stated-mm", tuple(h for h in NO_HEIGHTS if h != "nosuch=45")),
)
NO_REGIONS = (
    ("nan", "1", "0", "1"), ("0", "inf", "0", "1"), ("0", "0", "0", "1"), ("5", "1", "0", "5"), ("0", "1e-300", "0", "1"),
    ("-9", "-5", "0", "5"), ("1e308", "1e309", "0", "5"), ("0", "5", "9", "2"), ("a", "b", "c", "d"), ("0", "5", "0", ""),
)  # fmt: skip


def bad_options() -> Iterator[BadOption]:
    """Yield every row of the table."""
    for verb, arguments, option, values in NUMBERS:
        for value in values:
            yield BadOption(verb, arguments, option, (value,))
    for verb, arguments, option, values in TEXTS:
        for value in values:
            yield BadOption(verb, arguments, option, (value,))
    for region in NO_REGIONS:
        yield BadOption("track-sequence", ("{frames}", "--pixel-mm", "1", *DIAMETER), "--region-mm", region)
    for (verb, arguments, option), value, at in itertools.product(TRIPLES, LENGTH, range(3)):
        three = ["1", "1", "1"]
        three[at] = value
        yield BadOption(verb, arguments, option, tuple(three))
    for (verb, arguments, option), value in itertools.product(CHOICES, NO_CHOICES):
        yield BadOption(verb, arguments, option, (value,))
