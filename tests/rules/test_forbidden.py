"""What the law and the ECU must never do: allocate, ask for the time, recurse, keep state of their own, reach upwards.

Each check is tried on a copy with one violation in it.
"""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.rules.compilers import (
    CORE,
    LIMIT_S,
    ROOT,
    SCALARS,
    Outcome,
    Unit,
    append,
    copy_firmware,
    need,
    run_compilers,
    sources,
)

Configure = Callable[..., list[Unit]]

# ---- what the text says --------------------------------------------------------------------------

IDENTIFIERS = frozenset(
    """
    malloc calloc realloc free alloca aligned_alloc strdup
    goto setjmp longjmp abort exit _Exit atexit system getenv
    time clock gettimeofday clock_gettime clock_nanosleep nanosleep usleep sleep time_t clock_t timespec difftime
    printf fprintf sprintf snprintf vprintf vfprintf vsprintf vsnprintf puts fputs putchar putc scanf fscanf sscanf
    errno rand srand asm __asm__ __asm volatile register auto union
    """.split()
)
FLOATING = frozenset(("float", "double", "_Float16", "__float128", "_Complex"))
MAY_USE_FLOATING = re.compile(r"firmware/control/scalar\w*\.[ch]")
_TOKENS = re.compile(
    r'(?P<comment>/\*.*?\*/|//[^\n]*)|(?P<text>"(?:\\.|[^"\\\n])*"|\'(?:\\.|[^\'\\\n])*\')|(?P<word>\b[A-Za-z_]\w*)',
    re.DOTALL,
)


def forbidden_identifiers(root: Path) -> list[str]:
    """Where control/ and ecu/ use an identifier that is refused; comments and texts do not count."""
    found = []
    for source in sources("firmware/control/**/*.[ch]", "firmware/ecu/**/*.[ch]", "firmware/ecu/**/*.inc", root=root):
        text = (root / source).read_text("utf-8")
        refused = IDENTIFIERS if MAY_USE_FLOATING.fullmatch(source) else IDENTIFIERS | FLOATING
        for token in _TOKENS.finditer(text):
            if token["word"] in refused:
                found.append(f"{source}:{text.count(chr(10), 0, token.start()) + 1}: {token['word']}")
    return found


STANDARD = frozenset(("stdint.h", "stdbool.h", "stddef.h"))
_INCLUDE = re.compile(
    r'^[ \t]*#[ \t]*include[ \t]*(?:"(?P<own>[^"\n]+)"|<(?P<system>[^>\n]+)>|(?P<other>.*))', re.MULTILINE
)


def _may_include(source: str) -> tuple[tuple[str, ...], frozenset[str] | None]:
    """Folders and system headers that a file may include; None: any."""
    if source.startswith("firmware/control/"):
        return ("control/",), STANDARD
    if source.startswith("firmware/ecu/"):
        return ("control/", "ecu/", "can_protocol/generated/"), STANDARD
    port = source.split("/")[2]
    return ("ecu/", f"ports/{port}/"), None


def wrong_includes(root: Path) -> list[str]:
    """Includes that point upwards, sideways or to a library."""
    found = []
    for source in sources("firmware/**/*.[ch]", root=root):
        folders, system = _may_include(source)
        for include in _INCLUDE.finditer((root / source).read_text("utf-8")):
            own = include["own"] is not None and include["own"].startswith(folders) and ".." not in include["own"]
            known = include["system"] is not None and (system is None or include["system"] in system)
            if not own and not known:
                found.append(f"{source}: {include[0].strip()}")
    return found


def function_pointers(root: Path) -> list[str]:
    """Where control/ and ecu/ declare pointers to functions: through them a cycle of calls could hide."""
    found = []
    for source in sources("firmware/control/*.[ch]", "firmware/ecu/*.[ch]", root=root):
        text = (root / source).read_text("utf-8")
        found += [
            f"{source}: {pointer}"
            for pointer in re.findall(r"\(\s*\*\s*(?:const\s+)?(\w+)\s*(?:\[\w*\])?\)\s*\(", text)
        ]
    return found


# ---- what the objects say ------------------------------------------------------------------------

# Nothing optimised away, nothing inlined, constants where they belong; and the calls written beside the object.
PLAIN = ("-O0", "-fno-pic", "-fno-pie", "-g0", "-fcallgraph-info", "-Wvla", "-Walloca", "-Wpointer-arith")
# What a compiler itself calls to copy and to clear.
# fmaf: float's add_product on a host built for no processor in particular; one instruction on a Cortex-M4F
COMPILER_CALLS = frozenset(("memcpy", "memset", "memmove", "fmaf"))


@dataclass(frozen=True)
class Symbol:
    """One symbol of an object file."""

    unit: Unit
    name: str
    kind: str  # as nm prints it


def symbols(outcomes: Sequence[Outcome]) -> list[Symbol]:
    """All symbols of the objects."""
    found = []
    for outcome in outcomes:
        assert outcome.passed, outcome.said
        listing = subprocess.run(
            ["nm", "-P", str(outcome.object)], capture_output=True, text=True, timeout=LIMIT_S, check=True
        ).stdout
        found += [Symbol(outcome.unit, *line.split()[:2]) for line in listing.splitlines()]
    return found


def state(listed: Sequence[Symbol]) -> list[str]:
    """Objects in control/ and ecu/ that can be written and outlive a call."""
    return [
        f"{s.unit.source} ({s.unit.scalar}): {s.name}"
        for s in listed
        if s.kind in "bBcCdDsSgG" and s.unit.source.startswith(CORE)
    ]


def foreign_calls(listed: Sequence[Symbol], scalar: str) -> list[str]:
    """What control/ takes from elsewhere than control/, and ecu/ from elsewhere than control/, ecu/ and its frames."""
    mine = [s for s in listed if s.unit.scalar == scalar]
    control = {s.name for s in mine if s.kind.isupper() and s.kind != "U" and s.unit.source.startswith(CORE[0])}
    every = {s.name for s in mine if s.kind.isupper() and s.kind != "U"}
    found = []
    for symbol in mine:
        if symbol.kind in "Uwv" and symbol.unit.source.startswith(CORE):
            known = control if symbol.unit.source.startswith(CORE[0]) else every
            if symbol.name not in known | COMPILER_CALLS:
                found.append(f"{symbol.unit.source} ({scalar}): {symbol.name}")
    return found


_EDGE = re.compile(r'edge: \{ sourcename: "([^"]+)" targetname: "([^"]+)"')


def call_graph(outcomes: Sequence[Outcome], scalar: str) -> dict[str, set[str]]:
    """Who calls whom; names of static functions carry their file."""
    graph: dict[str, set[str]] = {}
    for outcome in outcomes:
        if outcome.unit.scalar == scalar:
            calls = outcome.object.with_suffix(".ci").read_text("utf-8")
            for caller, callee in _EDGE.findall(calls):
                graph.setdefault(caller, set()).add(callee)
    return graph


def recursion(graph: dict[str, set[str]]) -> list[str]:
    """Functions that can come back to themselves."""

    def reaches_itself(start: str) -> bool:
        seen: set[str] = set()
        waiting = list(graph.get(start, ()))
        while waiting:
            name = waiting.pop()
            if name == start:
                return True
            if name not in seen:
                seen.add(name)
                waiting += graph.get(name, ())
        return False

    return sorted(name.split("/")[-1] for name in graph if reaches_itself(name))


def plain(
    configure: Configure, folder: Path, chosen: Sequence[str] = (), root: Path = ROOT, scalars: Sequence[str] = SCALARS
) -> list[Outcome]:
    """Objects of control/, ecu/ and the frames, or of the `chosen` sources."""
    units = [
        unit
        for unit in configure()
        if unit.scalar in scalars
        and unit.source.startswith((*CORE, "can_protocol/"))
        and (not chosen or unit.source in chosen)
    ]
    return run_compilers(units, folder, PLAIN, compiler="gcc", root=root, drop=("-O2", "-g"))


@pytest.fixture(scope="module")
def objects(configure: Configure, tmp_path_factory: pytest.TempPathFactory) -> list[Outcome]:
    """Every object of the law, the ECU and its frames."""
    need("gcc", "nm")
    return plain(configure, tmp_path_factory.mktemp("objects"))


# ---- the firmware as it is -----------------------------------------------------------------------


def test_no_forbidden_identifier_is_used() -> None:
    """GIVEN control/ and ecu/ THEN no heap, no jump, no clock, no text; float and double in scalar*.[ch] alone."""
    assert forbidden_identifiers(ROOT) == []


def test_no_include_points_the_wrong_way() -> None:
    """GIVEN all of firmware/ THEN ports see the ECU, the ECU sees the law, the law sees neither; no library."""
    assert wrong_includes(ROOT) == []


def test_no_call_leaves_but_through_the_port() -> None:
    """GIVEN control/ and ecu/ THEN the ports' functions are the only ones that are called through a pointer."""
    assert function_pointers(ROOT) == [
        "firmware/ecu/port.h: send",
        "firmware/ecu/port.h: receive",
        "firmware/ecu/port.h: now_us",
        "firmware/ecu/store.h: read",
        "firmware/ecu/store.h: erase",
        "firmware/ecu/store.h: program",
    ]


def test_no_array_has_a_variable_length(objects: list[Outcome]) -> None:
    """GIVEN control/ and ecu/ WHEN compiled with -Wvla and -Walloca THEN the compiler says nothing."""
    assert [outcome.said for outcome in objects if outcome.said] == []


def test_no_state_outlives_a_call(objects: list[Outcome]) -> None:
    """GIVEN the objects of control/ and ecu/ THEN nothing in them can be written: two ECUs fit into one program."""
    assert {outcome.unit.scalar for outcome in objects} == set(SCALARS)
    assert state(symbols(objects)) == []


def test_no_function_from_outside_is_called(objects: list[Outcome]) -> None:
    """GIVEN the objects THEN the law calls itself alone, the ECU the law and its frames, whatever the text says."""
    listed = symbols(objects)
    assert [call for scalar in SCALARS for call in foreign_calls(listed, scalar)] == []


def test_no_function_recurses(objects: list[Outcome]) -> None:
    """GIVEN who calls whom WHEN followed THEN nobody comes back: the stack has a bound."""
    for scalar in SCALARS:
        graph = call_graph(objects, scalar)
        work = graph.get("firmware/ecu/ecu.c:work", set())  # unless the compiler has put it into its one caller
        assert "controller_step" in graph["ecu_tick_end"] | work  # it is the whole graph
        assert any("sine" in callee for callee in graph["wrist_trig"])
        assert recursion(graph) == []


def fixed_without_floating(configure: Configure, folder: Path, chosen: Sequence[str], root: Path) -> list[str]:
    """What gcc says of the fixed-point objects when it may not use a floating-point register."""
    units = [
        unit
        for unit in configure()
        if unit.scalar == "fixed" and unit.source.startswith(CORE) and (not chosen or unit.source in chosen)
    ]
    assert units
    outcomes = run_compilers(units, folder, ("-mgeneral-regs-only", "-g0"), compiler="gcc", root=root)
    return [f"{o.unit.source}: {o.said}" for o in outcomes if not o.passed]


def test_fixed_point_does_not_use_floating_point(configure: Configure, tmp_path: Path) -> None:
    """GIVEN the fixed-point type WHEN floating-point registers are refused THEN all compiles: constants are folded."""
    assert fixed_without_floating(configure, tmp_path, (), ROOT) == []


# ---- the checks themselves -----------------------------------------------------------------------


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A copy of the firmware that may be spoiled."""
    return copy_firmware(tmp_path / "copy")


@pytest.mark.parametrize(
    ("source", "code", "said"),
    [
        ("firmware/control/pid.c", "void *injected(void) { return malloc(4); }", "malloc"),
        ("firmware/ecu/ecu.c", "static void injected(void *p) { free (p); }", "free"),
        ("firmware/control/diarc.c", "static float injected;", "float"),
        ("firmware/ecu/wire.h", "typedef double injected;", "double"),
        ("firmware/control/observer.c", "int injected(void) { again: goto again; }", "goto"),
        ("firmware/ecu/transmit.c", "long injected(void) { return time(0); }", "time"),
        ("firmware/control/scalar_floating.c", "long injected(void) { return clock(); }", "clock"),
        ("firmware/ecu/parameters.c", 'int injected(void) { return printf("x"); }', "printf"),
    ],
)
def test_injected_identifier_is_not_missed(copy: Path, source: str, code: str, said: str) -> None:
    """GIVEN a forbidden identifier in a copy WHEN checked THEN file, line and identifier are named."""
    assert forbidden_identifiers(copy) == []
    lines = len((copy / source).read_text("utf-8").splitlines())
    append(copy, source, code)
    assert forbidden_identifiers(copy) == [f"{source}:{lines + 2}: {said}"]


def test_comment_or_text_is_no_violation(copy: Path) -> None:
    """GIVEN forbidden words in a comment, a text and a longer name WHEN checked THEN nothing is found."""
    append(
        copy,
        "firmware/ecu/ecu.c",
        '/* free float */ // double\nconst char *x = "malloc \\" goto";\nint time_us, freed;',
    )
    append(copy, "firmware/control/scalar.c", "float f; double d;")
    assert forbidden_identifiers(copy) == []


@pytest.mark.parametrize(
    ("source", "include"),
    [
        ("firmware/control/pid.c", '#include "ecu/port.h"'),
        ("firmware/control/pid.h", "#include <math.h>"),
        ("firmware/control/scalar.c", "#  include <stdlib.h>"),
        ("firmware/control/scalar.h", '#include "../ecu/wire.h"'),
        ("firmware/control/arm_model.c", '#include "control/../ecu/wire.h"'),
        ("firmware/ecu/ecu.c", "#include <string.h>"),
        ("firmware/ecu/e2e.c", "#include <time.h>"),
        ("firmware/ecu/transmit.c", "#include <stdio.h>"),
        ("firmware/ecu/ecu.h", '#include "ports/linux/clock.h"'),
        ("firmware/ports/inproc/inproc.c", '#include "ports/linux/bus.h"'),
        ("firmware/ports/linux/main.c", '#include "control/controller.h"'),
    ],
)
def test_injected_include_is_not_missed(copy: Path, source: str, include: str) -> None:
    """GIVEN an include that points the wrong way in a copy WHEN checked THEN file and include are named."""
    append(copy, source, include)
    assert wrong_includes(copy) == [f"{source}: {include}"]


def test_injected_function_pointer_is_not_missed(copy: Path) -> None:
    """GIVEN a pointer to a function in the law's copy WHEN checked THEN it is named."""
    append(copy, "firmware/control/pid.h", "struct injected { int (*call)(int x); };")
    assert "firmware/control/pid.h: call" in function_pointers(copy)


@pytest.mark.parametrize(
    "code",
    [
        "uint8_t injected(uint8_t n) { uint8_t a[n]; a[0] = n; return a[0]; }",
        "uint8_t injected(uint8_t n) { uint8_t *a = __builtin_alloca(n); a[0] = n; return a[0]; }",
    ],
)
def test_injected_variable_length_is_not_missed(copy: Path, configure: Configure, tmp_path: Path, code: str) -> None:
    """GIVEN an array of variable length in a copy WHEN compiled THEN the compiler refuses it."""
    append(copy, "firmware/ecu/e2e.c", code)
    outcome = plain(configure, tmp_path / "objects", ["firmware/ecu/e2e.c"], copy, ["fixed"])[0]
    assert not outcome.passed and re.search(r"-Werror=(vla|alloca)\b", outcome.said)


@pytest.mark.parametrize(
    ("code", "name"),
    [
        ("static uint8_t injected; uint8_t use(void) { return injected++; }", "injected"),
        ("uint8_t injected = 3;", "injected"),
        ("uint8_t use(void) { static uint8_t injected; return injected++; }", "injected"),
        ("static uint8_t injected;", ""),  # unused: refused by the compiler
        ("const uint8_t *injected = 0;", "injected"),
        ("_Thread_local uint8_t injected;", "injected"),
    ],
)
def test_injected_state_is_not_missed(copy: Path, configure: Configure, tmp_path: Path, code: str, name: str) -> None:
    """GIVEN an object that can be written in a copy WHEN its symbols are read THEN it is found."""
    append(copy, "firmware/ecu/e2e.c", code)
    outcomes = plain(configure, tmp_path / "objects", ["firmware/ecu/e2e.c"], copy, ["float"])
    if not name:
        assert not outcomes[0].passed
        return
    found = state(symbols(outcomes))
    assert len(found) == 1 and found[0].startswith(f"firmware/ecu/e2e.c (float): {name}")


def test_injected_call_is_not_missed(copy: Path, configure: Configure, tmp_path: Path) -> None:
    """GIVEN calls upwards and outwards under other names WHEN the objects' symbols are read THEN they are found."""
    append(copy, "firmware/control/pid.c", "int ecu_shutdown(int x); int injected(int x) { return ecu_shutdown(x); }")
    append(
        copy, "firmware/ecu/ecu.c", "int getpid(void); int injected2(void); int injected2(void) { return getpid(); }"
    )
    listed = symbols(plain(configure, tmp_path / "objects", root=copy, scalars=["double"]))
    assert sorted(foreign_calls(listed, "double")) == [
        "firmware/control/pid.c (double): ecu_shutdown",
        "firmware/ecu/ecu.c (double): getpid",
    ]


def test_injected_recursion_is_not_missed(copy: Path, configure: Configure, tmp_path: Path) -> None:
    """GIVEN a function that calls itself, and two that call each other across files THEN all three are found."""
    own = "int alone(int n); int alone(int n) { return n > 0 ? alone(n - 1) : 0; }"
    first = "int first(int n); int second(int n); int first(int n) { return n > 0 ? second(n - 1) : 0; }"
    second = "int first(int n); int second(int n); int second(int n) { return n > 0 ? first(n - 1) : 0; }"
    append(copy, "firmware/ecu/e2e.c", own)
    append(copy, "firmware/control/pid.c", first)
    append(copy, "firmware/control/observer.c", second)
    chosen = ["firmware/ecu/e2e.c", "firmware/control/pid.c", "firmware/control/observer.c"]
    outcomes = plain(configure, tmp_path / "objects", chosen, copy, ["fixed"])
    assert [outcome.said for outcome in outcomes if not outcome.passed] == []
    assert recursion(call_graph(outcomes, "fixed")) == ["alone", "first", "second"]


def test_injected_floating_point_is_not_missed(copy: Path, configure: Configure, tmp_path: Path) -> None:
    """GIVEN a product with a real constant, and no forbidden word, in a copy WHEN compiled THEN it is refused."""
    append(
        copy,
        "firmware/control/pid.c",
        "scalar injected(scalar x); scalar injected(scalar x) { return (scalar)(x * 0.5); }",
    )
    assert forbidden_identifiers(copy) == []
    assert len(fixed_without_floating(configure, tmp_path, ["firmware/control/pid.c"], copy)) == 1
