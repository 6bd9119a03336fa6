"""Budgets of the Cortex-M images: flash, RAM, worst-case stack, and instructions a tick.

Examples
--------
  python tools/budget.py             measure, print, write build/budget.json and the tables in README.md and docs
  python tools/budget.py --check     measure and compare with the record; exit 1 when a figure left its tolerance
  python tools/budget.py --record    measure and make this the record

The stack is the deepest path of the call graph (gcc's -fcallgraph-info=su, with the calls found in the machine code)
plus the deepest interrupt; recursion, a frame of unknown size and an indirect call without known targets are errors.
Instructions are counted by SysTick in QEMU with -icount, of every tick of runs with all laws and a tare, and of one
through every mode with a master that reads by SDO meanwhile (budget_modes.py).
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
if __name__ == "__main__":
    sys.path[0] = str(ROOT)
if str(ROOT / "tests" / "pil") not in sys.path:
    sys.path.append(str(ROOT / "tests" / "pil"))

from sil_plant.environment import enter, say  # noqa: E402

if __name__ == "__main__":
    enter(__file__)

import emulated_board  # noqa: E402
from emulated_board import IMAGES, BoardError, EmulatedBoard, Image  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

from sil_plant.bus.ports import BusError, parse_bus  # noqa: E402
from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.inputs.machine import REFERENCE_ARM, Machine, load_machine  # noqa: E402
from sil_plant.inputs.scenario import DEFAULT_SCENARIO, LoadStep, Scenario, load_scenario  # noqa: E402
from sil_plant.loop import execution, session  # noqa: E402
from sil_plant.loop.bus_run import EcuLostError, EcuMissingError  # noqa: E402
from tools import budget_floor, budget_modes  # noqa: E402

BUDGET_PATH = ROOT / "build" / "budget.json"
RECORD_PATH = ROOT / "tests" / "pil" / "budget_record.json"
START, END = "<!-- budget: made by tools/budget.py -->", "<!-- end of budget -->"
REFRESH = "python tools/budget.py --record"
GROWN, FALLEN = 1.02, 0.95  # of the recorded figure

# -O2 and all else stay as they are: a build type of its own only adds the call graph.
GRAPH = ("-DCMAKE_BUILD_TYPE=Graph", "-DCMAKE_C_FLAGS_GRAPH=-fcallgraph-info=su")
COUNT = "-DDIARC_COUNT_INSTRUCTIONS=ON"

# The run that is counted: what is carried changes on the way, so that the estimator also starts its filters anew.
LOADS = (LoadStep(0.0, 2.5), LoadStep(1.0, 7.5))
# Law and how long; the mean is of the first, the maximum of all. MODES is the run through every mode.
MODES = "modes"
RUNS = (("diarc", 3.0), ("pid", 1.0), ("diarc-noload", 1.0), (MODES, budget_modes.DURATION_S))
SHORT_RUNS = (("diarc", 3.0), ("pid", 0.5), ("diarc-noload", 0.5), (MODES, budget_modes.DURATION_S))
ATTEMPTS = 3  # of a check, before it says that instructions have grown

# Registers that the processor itself pushes when an interrupt comes, with the word that aligns the stack.
EXCEPTION_BYTES = {"float": 104 + 4, "fixed": 32 + 4}  # with and without those of the FPU
POINTERS = {"send": 4, "receive": 8, "now_us": 12}  # of struct ecu_port, and where in it
STORE_AT, STORE_POINTERS = 16, ("read", "erase", "program")  # of struct store_port, which no image has yet
PORT_SYMBOL, ROOT_FUNCTION = "the_port", "reset"
VECTORS_WORDS = 48  # the initial stack pointer, reset, 46 more

FIGURES = ("flash_bytes", "ram_bytes", "stack_bytes", "insn_mean", "insn_max", "insn_floor")
NAMES = {
    "flash_bytes": "flash, bytes",
    "ram_bytes": "RAM without the stack, bytes",
    "stack_bytes": "stack in the worst case, bytes",
    "insn_mean": "instructions a tick, mean",
    "insn_max": "instructions a tick, maximum",
    "insn_floor": "instructions the arithmetic alone needs",
}
STAGE_TITLES = {
    "receive": "receive",
    "frames: samples, supervision, packing": "frames",
    "estimate": "estimate",
    "control": "control",
    "send": "send",
    "a tick: all but receive": "tick",
    "UART": "uart",
}
GOALS = {
    preset: {"flash_bytes": 32 * 1024, "ram_bytes": 4096, "stack_bytes": 1024, "insn_max": instructions}
    for preset, instructions in (("cortex-m4f", 3_000), ("cortex-m3", 12_000))
}


class BudgetError(Exception):
    """A figure cannot be found; says why."""


@dataclass(frozen=True)
class Budget:
    """One image's figures."""

    flash_bytes: int
    ram_bytes: int
    stack_bytes: int
    insn_mean: int
    insn_max: int
    insn_floor: int


@dataclass(frozen=True)
class Measured:
    """A budget, and what it is made of."""

    budget: Budget
    stages: dict[str, tuple[int, int]]  # mean and maximum instructions
    deepest: list[str]  # functions, from reset on


def tool(name: str, *arguments: str) -> str:
    """What a program of the Arm toolchain prints."""
    command = [f"arm-none-eabi-{name}", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise BudgetError(f"{' '.join(command)} failed: {done.stderr[-500:]}")
    return done.stdout


# ---- memory --------------------------------------------------------------------------------------


def memory(elf: Path) -> tuple[int, int]:
    """Bytes of flash (.text, .ARM.exidx and the initial values of .data) and of RAM (.data and .bss)."""
    sizes: dict[str, int] = {}
    for line in tool("size", "-A", str(elf)).splitlines():
        words = line.split()
        if len(words) == 3 and words[1].isdigit():
            sizes[words[0]] = int(words[1])
    if ".text" not in sizes or ".stack" not in sizes:
        raise BudgetError(f"{elf.name} has no .text or no .stack: {sorted(sizes)}")
    ram = sizes.get(".data", 0) + sizes.get(".bss", 0)
    return sizes[".text"] + sizes.get(".ARM.exidx", 0) + sizes.get(".data", 0), ram


# ---- stack ---------------------------------------------------------------------------------------


class CallGraph:
    """Frames and calls by function name; of two functions of one name the larger frame and the calls of both.

    Attributes
    ----------
    frame : dict
        Bytes of stack of each function.
    calls : dict
        Names it calls.
    pointers : dict
        Places in the source where it calls through a pointer.
    """

    def __init__(self) -> None:
        self.frame: dict[str, int] = {}
        self.calls: dict[str, set[str]] = {}
        self.pointers: dict[str, list[str]] = {}

    def add_compiler(self, text: str) -> None:
        """Take one file of -fcallgraph-info=su in.

        Raises
        ------
        BudgetError
            When a frame's size is not constant.
        """
        for title, label in re.findall(r'^node: \{ title: "([^"]*)" label: "([^"]*)"', text, re.MULTILINE):
            size = re.search(r"\\n(\d+) bytes \(([a-z,]+)\)", label)
            if size is None:
                continue
            name = _function(title)
            if size[2] != "static":
                raise BudgetError(f"the frame of {name} is not of constant size ({size[2]})")
            self.frame[name] = max(self.frame.get(name, 0), int(size[1]))
        for source, target, place in re.findall(
            r'^edge: \{ sourcename: "([^"]*)" targetname: "([^"]*)"(?: label: "([^"]*)")?', text, re.MULTILINE
        ):
            if target == "__indirect_call":
                self.pointers.setdefault(_function(source), []).append(place)
            else:
                self.calls.setdefault(_function(source), set()).add(_function(target))

    def add_machine_code(self, text: str) -> None:
        """Add the calls of a disassembly, and frames of functions that the compiler did not make (libgcc).

        Raises
        ------
        BudgetError
            When code goes where a register says outside the calls that the compiler told of.
        """
        known = set(self.frame)
        for header, body in re.findall(r"^[0-9a-f]+ <([^>]+)>:\n((?:.+\n)*)", text, re.MULTILINE):
            name = _function(header)
            called = re.findall(r"\tb[a-z]*(?:\.[nw])?\t[0-9a-f]+ <([^>+]+)>", body)
            self.calls.setdefault(name, set()).update(_function(c) for c in called if c != header)
            jumps = re.findall(r"\t(blx?\tr\w+|bx\t(?!lr)\w+|(?:mov|ldr)[a-z.]*\tpc, (?!\[sp\]).*)", body)
            if name in known:  # a switch: the compiler has told of every call through a pointer
                jumps = [jump for jump in jumps if not re.match(r"ldr[a-z.]*\tpc, \[r\d+, r\d+, lsl #2\]", jump)]
            if jumps and name not in self.pointers:
                raise BudgetError(f"{name} calls through a pointer that is in no call graph: {jumps}")
            if name not in known:
                self.frame[name] = max(self.frame.get(name, 0), _pushed(name, body))

    def add_aliases(self, symbols: list[tuple[int, str, str]]) -> None:
        """Know a function by all of its names: of functions with the same code the linker's compiler keeps one.

        Parameters
        ----------
        symbols : list
            Address, kind and name of each of the image's symbols.
        """
        names: dict[int, list[str]] = {}
        for address, kind, name in symbols:
            if kind in "tTwW":
                names.setdefault(address, []).append(_function(name))
        for same in names.values():
            known = [name for name in same if name in self.frame]
            for name in same:
                if known and name not in self.frame:
                    self.frame[name] = self.frame[known[0]]
                    self.calls[name] = set(self.calls.get(known[0], ()))

    def resolve(self, targets: dict[str, str]) -> None:
        """Replace calls through the port's pointers by calls of what is in them.

        Parameters
        ----------
        targets : dict
            Member of struct ecu_port or store_port, and function; "" for one that is never called.

        Raises
        ------
        BudgetError
            When a call goes through anything else.
        """
        for name, places in self.pointers.items():
            for place in places:
                path, line, column = place.rsplit(":", 2)
                text = Path(path).read_text(encoding="utf-8").splitlines()[int(line) - 1]
                member = re.match(r"(?:\w+ = )?port->(\w+)\(", text[int(column) - 1 :])
                if member is None or member[1] not in targets:
                    raise BudgetError(f"{name} calls through a pointer of unknown content: {place}: {text.strip()}")
                if targets[member[1]]:
                    self.calls.setdefault(name, set()).add(targets[member[1]])

    def deepest(self, root: str, path: tuple[str, ...] = ()) -> tuple[int, list[str]]:
        """Bytes and functions of the deepest path from a function.

        Raises
        ------
        BudgetError
            On recursion, and when a function's frame is not known.
        """
        self._found: dict[str, tuple[int, list[str]]] = {}
        return self._deepest(root, path)

    def _deepest(self, name: str, path: tuple[str, ...]) -> tuple[int, list[str]]:
        if name in path:
            raise BudgetError(f"recursion: {' -> '.join([*path[path.index(name) :], name])}")
        if name not in self._found:
            if name not in self.frame:
                raise BudgetError(f"the frame of {name}, called from {path[-1] if path else 'nowhere'}, is not known")
            below = [self._deepest(called, (*path, name)) for called in sorted(self.calls.get(name, ()))]
            size, names = max(below, key=lambda found: found[0], default=(0, []))
            self._found[name] = (self.frame[name] + size, [name, *names])
        return self._found[name]


def _function(title: str) -> str:
    """Name without the file before it."""
    return title.rsplit(":", 1)[-1]


def _pushed(name: str, body: str) -> int:
    """Bytes that machine code pushes, all of its pushes together: never less than its frame."""
    size = 0
    for instruction, operands in re.findall(r"^ +[0-9a-f]+:\t([a-z0-9.]+)\t([^@;\n]*)", body, re.MULTILINE):
        registers = len(re.findall(r"\w+", operands.split("{")[-1])) if "{" in operands else 0
        if instruction in ("push", "stmdb", "push.w", "stmdb.w") and ("push" in instruction or "sp!" in operands):
            size += 4 * registers
        elif re.match(r"sub[a-z.]*$", instruction) and (step := re.match(r"sp, (?:sp, )?#(\d+)", operands.strip())):
            size += int(step[1])
        elif step := re.search(r"\[sp, #-(\d+)\]!", operands):
            size += int(step[1])
        elif instruction.startswith(("vpush", "vstmdb")) or re.match(
            r"(sub|mov)[a-z.]*\tsp,", f"{instruction}\t{operands}"
        ):
            raise BudgetError(f"what {name} does to the stack pointer is not understood: {instruction} {operands}")
    return size


def call_graph(elf: Path) -> CallGraph:
    """The graph of an image that was built with GRAPH."""
    graph = CallGraph()
    commands = json.loads((elf.parent / "compile_commands.json").read_text(encoding="utf-8"))
    sources = {str(Path(command["file"]).resolve()) for command in commands if not _linked_as_one(command["command"])}
    for path in sorted(elf.parent.glob(f"{elf.name}.ltrans*.ci")):
        graph.add_compiler(path.read_text(encoding="utf-8"))
    if len(sources) < len(commands) and not graph.frame:
        raise BudgetError(f"no call graph of what the linker compiled for {elf.name}")
    for path in sorted(elf.parent.rglob("*.ci")):
        text = path.read_text(encoding="utf-8")
        title = re.match(r'graph: \{ title: "([^"]*)"', text)
        if title is not None and str(Path(title[1]).resolve()) in sources:  # else of a source that is gone
            graph.add_compiler(text)
            sources.discard(str(Path(title[1]).resolve()))
    if sources:
        raise BudgetError(f"no call graph of {', '.join(sorted(sources))}")
    graph.add_machine_code(tool("objdump", "-d", "--no-show-raw-insn", str(elf)))
    graph.add_aliases(_symbols(elf))
    if graph.pointers:  # where there are none the compiler has put the port's functions in their places
        graph.resolve(port_functions(elf))
    return graph


def _linked_as_one(command: str) -> bool:
    """Whether this command leaves the compiling to the linker, which then says what calls what."""
    flags = [word for word in command.split() if word in ("-flto", "-fno-lto")]
    return flags[-1:] == ["-flto"]


def _symbols(elf: Path) -> list[tuple[int, str, str]]:
    """Address, kind and name."""
    lines = (line.split() for line in tool("nm", str(elf)).splitlines())
    return [(int(words[0], 16), words[1], words[2]) for words in lines if len(words) == 3]


def _words(elf: Path, begin: int, count: int) -> list[int]:
    """32-bit words of the code's section from an address on."""
    limits = (f"--start-address={begin}", f"--stop-address={begin + 4 * count}")
    dump = tool("objdump", "-s", "-j", ".text", *limits, str(elf))
    lines = re.findall(r"^ [0-9a-f]+ ((?:[0-9a-f]+ ){1,4})", dump, re.MULTILINE)
    raw = bytes.fromhex("".join(lines).replace(" ", ""))
    return [int.from_bytes(raw[4 * k : 4 * k + 4], "little") for k in range(count)]


def _functions_at(elf: Path, addresses: list[int]) -> list[str]:
    """Names of the functions that pointers hold."""
    by_address = {address: name for address, kind, name in _symbols(elf) if kind in "tTwW"}
    missing = [hex(address) for address in addresses if address & ~1 not in by_address]
    if missing:
        raise BudgetError(f"no function at {', '.join(missing)}")
    return [_function(by_address[address & ~1]) for address in addresses]


def port_functions(elf: Path) -> dict[str, str]:
    """What the image's one port has in its pointers."""
    begin = [address for address, _, name in _symbols(elf) if name == PORT_SYMBOL]
    if len(begin) != 1:
        raise BudgetError(f"{elf.name} has not one {PORT_SYMBOL} but {len(begin)}")
    words = _words(elf, begin[0], 5)
    if words[STORE_AT // 4] != 0:
        raise BudgetError(f"{elf.name} has a store: say here what is in its pointers")
    functions = _functions_at(elf, [words[at // 4] for at in POINTERS.values()])
    return dict(zip(POINTERS, functions, strict=True)) | dict.fromkeys(STORE_POINTERS, "")


def interrupt_functions(elf: Path) -> set[str]:
    """What is in the vector table but for the reset."""
    return set(_functions_at(elf, [word for word in _words(elf, 0, VECTORS_WORDS)[2:] if word != 0]))


def worst_stack(elf: Path, scalar: str) -> tuple[int, list[str]]:
    """Bytes of the deepest path with the deepest interrupt on top, and the functions on it.

    All interrupts have the same priority, so none comes on top of another.
    """
    graph = call_graph(elf)
    size, names = graph.deepest(ROOT_FUNCTION)
    top, handler = max((graph.deepest(name) for name in interrupt_functions(elf)), key=lambda found: found[0])
    return size + EXCEPTION_BYTES[scalar] + top, [*names, "interrupt", *handler]


# ---- instructions --------------------------------------------------------------------------------


def counted_scenario() -> Scenario:
    """The benchmark's moves with LOADS."""
    return replace(load_scenario(DEFAULT_SCENARIO), load=LOADS)


Runs = tuple[tuple[str, float], ...]


def make_run(machine: Machine, scenario: Scenario, law: str, duration_s: float) -> session.Session:
    """One of the runs."""
    if law == MODES:
        return budget_modes.make(machine, scenario)
    scenario = replace(scenario, duration_s=duration_s)
    return session.make_session(machine, scenario, law, scenario.seed, execution.PERIOD_US * 1e-6, True)


def count(image: Image, elf: Path, machine: Machine, runs: Runs) -> tuple[dict[str, tuple[int, int]], int]:
    """Mean and most instructions of each stage over the runs, and the stack that was seen in use.

    Receive and UART depend on when the host delivers its bytes. The others do not: the same run gives the same counts,
    to one instruction.
    """
    scenario = counted_scenario()
    ticks, sums = [0], [dict.fromkeys(emulated_board.STAGES, 0)]
    with EmulatedBoard(image, elf, counting=True) as board:
        for law, duration_s in runs:
            run = make_run(machine, scenario, law, duration_s)
            execution.over_bus(run, parse_bus(board.bus), None, b"", lambda _: board.check(), True)
            failed = budget_modes.failure(run) if law == MODES else execution.outcome(run)
            if failed is not None:
                raise BudgetError(f"the counted run under {law} failed: {failed}")
            figures = board.figures()  # of all runs so far
            ticks.append(figures.ticks)
            sums.append({name: values[1] * figures.ticks for name, values in figures.instructions.items()})
    means = [
        {name: (after[name] - before[name]) / (ticks[k + 1] - ticks[k]) for name in after}
        for k, (before, after) in enumerate(pairwise(sums))
    ]
    stages = {
        name: (round(means[0][name]), values[2]) for name, values in figures.instructions.items() if name != "wait"
    }
    return stages, figures.stack_bytes


def measure(image: Image, machine: Machine, runs: Runs) -> Measured:
    """Build an image, plain and counting, and find all of its figures."""
    elf = emulated_board.build(image, f"budget/{image.preset}", GRAPH)
    counting = emulated_board.build(image, f"budget/{image.preset}-counting", [*GRAPH, COUNT])
    flash, ram = memory(elf)
    stack, deepest = worst_stack(elf, image.scalar)
    bound = worst_stack(counting, image.scalar)[0]
    stages, used = count(image, counting, machine, runs)
    if used > bound:
        raise BudgetError(f"{image.preset} used {used} bytes of stack, more than the call graph's {bound}")
    insn_mean, insn_max = stages["tick"]
    budget = Budget(flash, ram, stack, insn_mean, insn_max, budget_floor.floor(image.scalar))
    return Measured(budget, stages, deepest)


def least(measured: dict[str, Measured], again: dict[str, Measured]) -> dict[str, Measured]:
    """The first measurement, with instructions no more than in the second.

    An interrupt that comes inside a stage adds its entry to it, and when a byte comes is the host's doing: it never
    takes any away.
    """
    found = {}
    for preset, one in measured.items():
        two = again[preset]
        stages = {name: (mean, min(most, two.stages[name][1])) for name, (mean, most) in one.stages.items()}
        insn_mean = min(one.budget.insn_mean, two.budget.insn_mean)
        insn_max = min(one.budget.insn_max, two.budget.insn_max)
        found[preset] = replace(one, budget=replace(one.budget, insn_mean=insn_mean, insn_max=insn_max), stages=stages)
    return found


def measure_against(record: dict[str, dict[str, int]]) -> dict[str, dict[str, int]]:
    """The figures; measured again, and the least taken, while they are not where the record has them."""
    measured = measure_all(SHORT_RUNS)
    for _ in range(ATTEMPTS - 1):
        if not compare(record, figures_of(measured)):
            break
        measured = least(measured, measure_all(SHORT_RUNS))
    return figures_of(measured)


def measure_all(runs: Runs = RUNS) -> dict[str, Measured]:
    """Every image, at the same time."""
    machine = load_machine(REFERENCE_ARM)
    execution.compile_plant(machine, counted_scenario())
    with ThreadPoolExecutor() as pool:
        found = list(pool.map(lambda image: measure(image, machine, runs), IMAGES))
    return {image.preset: measured for image, measured in zip(IMAGES, found, strict=True)}


# ---- record --------------------------------------------------------------------------------------


def compare(record: dict[str, dict[str, int]], measured: dict[str, dict[str, int]]) -> list[str]:
    """A line for each figure that is not where the record has it.

    Parameters
    ----------
    record, measured : dict
        Figures by preset.
    """
    lines = []
    for preset in sorted({*record, *measured}):
        for name in FIGURES:
            was, now = record.get(preset, {}).get(name), measured.get(preset, {}).get(name)
            if was is None or now is None:
                lines.append(f"{preset} {name}: recorded {was}, measured {now}: one of them is missing")
            elif now > GROWN * was:
                lines.append(f"{preset} {name}: recorded {was}, measured {now}: grown by {_percent(now, was)}")
            elif now < FALLEN * was:
                lines.append(
                    f"{preset} {name}: recorded {was}, measured {now}: fallen by {_percent(was, now, was)}, "
                    "tighten the record"
                )
    return lines


def _percent(more: int, less: int, of: int | None = None) -> str:
    return f"{100.0 * (more - less) / max(1, of or less):.1f} %"


def dump(path: Path, measured: dict[str, dict[str, int]]) -> None:
    """Write figures as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(measured, indent=2) + "\n", encoding="utf-8")


def figures_of(measured: dict[str, Measured]) -> dict[str, dict[str, int]]:
    """What build/budget.json and the record hold."""
    return {preset: asdict(found.budget) for preset, found in measured.items()}


# ---- tables --------------------------------------------------------------------------------------


def budget_rows(measured: dict[str, Measured]) -> list[list[str]]:
    """Figure, then measured and goal of each image."""
    rows = []
    for name in FIGURES:
        row = [NAMES[name]]
        for preset, found in measured.items():
            value, goal = getattr(found.budget, name), GOALS[preset].get(name)
            row += [f"{value:,}", "" if goal is None else f"{goal:,}, {'met' if value <= goal else 'missed'}"]
        rows.append(row)
    ratios = (found.budget.insn_mean / found.budget.insn_floor for found in measured.values())
    rows.append(["mean over what the arithmetic needs", *(cell for ratio in ratios for cell in (f"{ratio:.1f}", ""))])
    return rows


def budget_head(measured: dict[str, Measured]) -> list[str]:
    """Head of budget_rows."""
    scalars = {image.preset: image.scalar for image in IMAGES}
    return ["", *(cell for preset in measured for cell in (f"{preset}, {scalars[preset]}", "goal"))]


def stage_rows(measured: dict[str, Measured]) -> list[list[str]]:
    """Stage, then mean and maximum of each image."""
    rows = []
    for title, name in STAGE_TITLES.items():
        rows.append([title, *(f"{found.stages[name][k]:,}" for found in measured.values() for k in (0, 1))])
    return rows


def markdown(head: list[str], rows: list[list[str]]) -> str:
    """A table."""
    lines = [head, ["---"] + ["---:"] * (len(head) - 1), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def readme_part(measured: dict[str, Measured]) -> str:
    """What stands in README.md."""
    return "\n\n".join(
        [
            markdown(budget_head(measured), budget_rows(measured)),
            "Instructions are those of a tick but for receiving, counted in QEMU; how, and what the arithmetic\n"
            "needs: [docs/porting.md](docs/porting.md#what-it-costs). `make budget` measures again.",
        ]
    )


def document_part(measured: dict[str, Measured]) -> str:
    """What stands in docs/porting.md."""
    presets = [cell for preset in measured for cell in (f"{preset}: mean", "maximum")]
    floor_rows = [
        [name, *(f"{value:g}" for value in asdict(operations).values())] for name, operations in budget_floor.terms()
    ]
    floor_rows.append(["all", *(f"{value:g}" for value in asdict(budget_floor.total()).values())])
    cost = asdict(budget_floor.COST["fixed"])
    runs = ", ".join(f"{duration_s:g} s under {law}" for law, duration_s in RUNS)
    loads = ", ".join(f"{step.load_kg:g} kg from {step.time_s:g} s on" for step in LOADS)
    paths = [f"- {preset}: `{' > '.join(found.deepest)}`" for preset, found in measured.items()]
    return "\n\n".join(
        [
            markdown(budget_head(measured), budget_rows(measured)),
            "- **Flash** is code, constants and the initial values of `.data`; **RAM** is `.data` and `.bss`. The\n"
            "  linker script sets 4096 bytes aside for the stack besides.\n"
            "- **Stack** is the deepest path of the call graph from `reset`, plus the registers that the processor\n"
            "  pushes and the deepest interrupt. Frames are the compiler's (`-fcallgraph-info=su`), those of libgcc\n"
            "  are read from the machine code. Calls through pointers are the port's three: the compiler sees the\n"
            "  whole image and makes direct ones of them, or else they are resolved from what is in `the_port`.\n"
            "  Recursion, a frame that is not constant, or any other pointer is an error.\n"
            "- **Instructions** are of every tick from the opening of the channel on, in every mode.\n"
            f"  Counted in QEMU over {runs}\n"
            f"  ({loads}); the mean is of the first run, the maximum of all ticks of all.\n"
            f"  `{MODES}` (`tools/budget_modes.py`) is moves broken off by HOLD and by SAFE_STOP, COMMISSION, a\n"
            "  fault and its reset, and leaving operational with the valves open, while a master reads by SDO.\n"
            "  The figure compared is a tick's frames, estimate, control and send together: a run gives the\n"
            "  same counts, to a few, unless a byte comes in between: its interrupt's entry is counted too, so the\n"
            "  least of repeated measurements is taken. What measuring itself takes is taken off.\n"
            "  Receiving depends on how the UART's bytes arrive and is not in the figure; its maximum is the\n"
            "  longest wait for sensors that do not answer, 250 ms, in which each period wakes the main loop once.",
            "Instructions a tick, by stage:",
            markdown(["", *presets], stage_rows(measured)),
            "`receive`, `send` and `UART` are mostly SLCAN text. `estimate` is `estimator_step`, `control` the\n"
            "rest of `controller_step`: reference, observer, cylinder geometry, law. The image that counts is the\n"
            "same code; a function that measures is called in front of each of these two.",
            "The deepest paths:\n\n" + "\n".join(paths),
            "What the arithmetic needs, in operations a tick, counted by hand in `tools/budget_floor.py`; no loads,\n"
            "stores, calls or comparisons:",
            markdown(["", "mul", "add", "div", "root"], floor_rows),
            "In instructions: one for each with an FPU; in fixed point, as an assumption, "
            f"{cost['mul']} for a product, {cost['add']} for a\nsum, {cost['div']} for a quotient and "
            f"{cost['root']} for a root.",
        ]
    )


def insert(text: str, part: str, name: str) -> str:
    """The text with what is between the markers made anew.

    Raises
    ------
    BudgetError
        When the markers are not there once, in order.
    """
    if text.count(START) != 1 or text.count(END) != 1 or text.index(END) < text.index(START):
        raise BudgetError(f"{name}: the markers `{START}` and `{END}` are needed once, in this order")
    return f"{text.split(START)[0]}{START}\n{part}\n{END}{text.split(END)[1]}"


def write_tables(measured: dict[str, Measured]) -> None:
    """Refresh README.md and docs/porting.md."""
    for name, part in (("README.md", readme_part(measured)), ("docs/porting.md", document_part(measured))):
        path = ROOT / name
        old = path.read_text(encoding="utf-8")
        new = insert(old, part, name)
        if new != old:
            path.write_text(new, encoding="utf-8")
            print(f"wrote: {name}")


def show(measured: dict[str, Measured]) -> None:
    """Print all tables."""
    console = Console()
    stage_head = ["instructions a tick", *(cell for preset in measured for cell in (f"{preset}: mean", "most"))]
    for head, rows in ((budget_head(measured), budget_rows(measured)), (stage_head, stage_rows(measured))):
        table = Table(*head)
        for row in rows:
            table.add_row(*row)
        console.print(table)
    table = Table("what the arithmetic needs", "mul", "add", "div", "root")
    for name, operations in [*budget_floor.terms(), ("all", budget_floor.total())]:
        table.add_row(name, *(f"{value:g}" for value in asdict(operations).values()))
    console.print(table)
    for preset, found in measured.items():
        console.print(f"{preset}, deepest path: {' > '.join(found.deepest)}", highlight=False)


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--check", action="store_true", help="compare with the record, write build/budget.json only")
    group.add_argument("--record", action="store_true", help="make what is measured the record")
    arguments = parser.parse_args()
    try:
        if arguments.check:
            figures = measure_against(read_record())
            dump(BUDGET_PATH, figures)
            return check(figures)
        measured = least(measure_all(RUNS), measure_all(SHORT_RUNS))
        figures = figures_of(measured)
        dump(BUDGET_PATH, figures)
        show(measured)
        write_tables(measured)
        if arguments.record:
            dump(RECORD_PATH, figures)
            print(f"wrote: {RECORD_PATH.relative_to(ROOT)}")
    except (BudgetError, BoardError, BusError, ConfigError, EcuMissingError, EcuLostError, OSError) as error:
        say(f"budget: {error}")
        return 2
    return 0


def read_record(path: Path = RECORD_PATH) -> dict[str, dict[str, int]]:
    """The recorded figures.

    Raises
    ------
    BudgetError
        When there are none that can be read.
    """
    try:
        record: dict[str, dict[str, int]] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise BudgetError(f"{path.name} cannot be read ({error}); make it: {REFRESH}") from error
    return record


def check(figures: dict[str, dict[str, int]], record_path: Path = RECORD_PATH) -> int:
    """Say where the figures left the record: 0 when nowhere, else 1."""
    lines = compare(read_record(record_path), figures)
    for line in lines:
        say(f"budget: {line}")
    if lines:
        say(f"budget: if that is meant, refresh {record_path.name}: {REFRESH}")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
