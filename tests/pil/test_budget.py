"""Budgets of the images: a figure that leaves its record is noticed, and so is stack that the call graph misses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tools import budget, budget_floor

MACHINE_CODE = """
00000100 <first>:
 100:\tpush\t{r4, lr}
 102:\tbl\t200 <second>
 106:\tpop\t{r4, pc}

00000200 <second>:
 200:\tstmdb\tsp!, {r4, r5, r6, lr}
 204:\tsub\tsp, #24
 206:\tb.w\t300 <third>

00000300 <third>:
 300:\tbx\tlr
"""
Figures = dict[str, dict[str, int]]


@pytest.fixture
def record() -> Figures:
    """A copy of the committed record."""
    figures: Figures = json.loads(budget.RECORD_PATH.read_text(encoding="utf-8"))
    return figures


def changed(figures: Figures, preset: str, name: str, factor: float) -> Figures:
    return {**figures, preset: {**figures[preset], name: round(figures[preset][name] * factor)}}


def test_budget_has_not_left_its_record(record: Figures) -> None:
    """GIVEN the images as they are WHEN flash, RAM, stack and instructions are measured THEN each is within 2 % above
    and 5 % below its record, and the stack in use was within what the call graph says."""
    lines = budget.compare(record, budget.measure_against(record))
    assert not lines, "\n".join([*lines, f"if that is meant: {budget.REFRESH}"])


def test_record_lists_every_figure_of_every_image(record: Figures) -> None:
    """GIVEN the record WHEN it is read THEN no image and no figure is missing, so that none goes unwatched."""
    assert set(record) == {image.preset for image in budget.IMAGES}
    for figures in record.values():
        assert set(figures) == set(budget.FIGURES)


@pytest.mark.parametrize("preset", ["cortex-m4f", "cortex-m3"])
@pytest.mark.parametrize("name", budget.FIGURES)
def test_figure_that_grew_or_fell_is_noticed(
    preset: str, name: str, record: Figures, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """GIVEN a record WHEN one figure is 3 % above or 6 % below it THEN the check fails with that figure, both values
    and the command; 1 % above and 4 % below pass."""
    path = tmp_path / "record.json"
    budget.dump(path, record)
    for factor, word in ((1.03, "grown"), (0.94, "fallen")):
        measured = changed(record, preset, name, factor)
        assert budget.check(measured, path) == 1
        said = capsys.readouterr().err
        for part in (f"{preset} {name}", str(record[preset][name]), str(measured[preset][name]), word, budget.REFRESH):
            assert part in said
        assert said.count("recorded") == 1
    for factor in (1.01, 1.0, 0.96):
        assert budget.check(changed(record, preset, name, factor), path) == 0


def test_figure_or_image_that_is_not_in_the_record_is_noticed(record: Figures) -> None:
    """GIVEN a record without a figure or an image WHEN it is compared THEN what is missing is said."""
    without_figure = {preset: {k: v for k, v in f.items() if k != "stack_bytes"} for preset, f in record.items()}
    assert len(budget.compare(without_figure, record)) == len(record)
    assert len(budget.compare({}, record)) == len(record) * len(budget.FIGURES)
    assert len(budget.compare(record, {})) == len(record) * len(budget.FIGURES)


def test_byte_that_came_inside_a_stage_is_no_growth(monkeypatch: pytest.MonkeyPatch, record: Figures) -> None:
    """GIVEN a run that an interrupt made longer WHEN it is compared THEN it is measured again and the least counts; a
    figure that stays too high is reported after all attempts."""

    def measured(factor: float) -> dict[str, budget.Measured]:
        figures = {name: changed(record, name, "insn_max", factor)[name] for name in record}
        return {name: budget.Measured(budget.Budget(**f), {"tick": (1, 2)}, []) for name, f in figures.items()}

    for factors, differs in (((1.05, 1.0, 1.0), 0), ((1.05, 1.05, 1.0), 0), ((1.05, 1.04, 1.05), len(record))):
        left = iter(factors)
        monkeypatch.setattr(budget, "measure_all", lambda _, left=left: measured(next(left)))
        assert len(budget.compare(record, budget.measure_against(record))) == differs


def test_record_that_cannot_be_read_is_named_with_the_command(tmp_path: Path) -> None:
    """GIVEN no record WHEN it is read THEN the message has the command that makes it."""
    with pytest.raises(budget.BudgetError, match=f"record.json .*{budget.REFRESH}"):
        budget.read_record(tmp_path / "record.json")


def test_frames_of_a_library_are_read_from_its_machine_code() -> None:
    """GIVEN functions without a compiler's call graph WHEN the deepest path is sought THEN pushes, room below them and
    calls that do not return here count."""
    graph = budget.CallGraph()
    graph.add_machine_code(MACHINE_CODE)
    assert graph.deepest("first") == (8 + 16 + 24, ["first", "second", "third"])


def test_recursion_is_refused_instead_of_counted_once() -> None:
    """GIVEN functions that call each other WHEN the deepest path is sought THEN the circle is named."""
    graph = budget.CallGraph()
    graph.frame = {"a": 8, "b": 8, "c": 8}
    graph.calls = {"a": {"b"}, "b": {"c"}, "c": {"b"}}
    with pytest.raises(budget.BudgetError, match="recursion: b -> c -> b"):
        graph.deepest("a")


def test_function_without_known_frame_is_refused_instead_of_counted_as_nothing() -> None:
    """GIVEN a call of a function nobody has a frame of WHEN the deepest path is sought THEN it is named."""
    graph = budget.CallGraph()
    graph.frame, graph.calls = {"a": 8}, {"a": {"elsewhere"}}
    with pytest.raises(budget.BudgetError, match="elsewhere, called from a"):
        graph.deepest("a")


def test_frame_of_variable_size_is_refused() -> None:
    """GIVEN a function with an array of variable length WHEN its call graph is read THEN it is named."""
    text = 'node: { title: "f" label: "f\\nx.c:1:1\\n16 bytes (dynamic)" }\n'
    with pytest.raises(budget.BudgetError, match=r"frame of f .*dynamic"):
        budget.CallGraph().add_compiler(text)


@pytest.mark.parametrize("line", ["table[k](x);", "other->send(x);", "port->reset(x);"])
def test_call_through_an_unknown_pointer_is_refused(line: str, tmp_path: Path) -> None:
    """GIVEN a call through anything but the port's pointers WHEN calls are resolved THEN the place is named."""
    source = tmp_path / "x.c"
    source.write_text(f"{line}\n", encoding="utf-8")
    graph = budget.CallGraph()
    graph.pointers = {"f": [f"{source}:1:1"]}
    with pytest.raises(budget.BudgetError, match=r"unknown content: .*x\.c:1:1"):
        graph.resolve({"send": "slcan_send"})


def test_jump_through_a_register_that_the_compiler_does_not_tell_of_is_refused() -> None:
    """GIVEN machine code that calls a register's address WHEN the compiler's graph has no such call THEN it is
    named."""
    with pytest.raises(budget.BudgetError, match="f calls through a pointer"):
        budget.CallGraph().add_machine_code("00000100 <f>:\n 100:\tblx\tr3\n 102:\tbx\tlr\n")


def test_calls_through_the_port_are_those_of_the_image() -> None:
    """GIVEN a call of the port's send WHEN calls are resolved THEN the path goes through the function that is in it."""
    path = budget.ROOT / "firmware" / "ecu" / "transmit.c"
    lines = path.read_text(encoding="utf-8").splitlines()
    row = next(k for k, line in enumerate(lines) if "port->send(" in line)
    graph = budget.CallGraph()
    graph.pointers = {"f": [f"{path}:{row + 1}:{lines[row].index('port->send(') + 1}"]}
    graph.resolve({"send": "slcan_send"})
    assert graph.calls == {"f": {"slcan_send"}}


def test_floor_counts_the_textbook_update_of_a_full_row() -> None:
    """GIVEN a row without zeros WHEN its UD update is counted THEN it is Bierman's: of order 1.5 n^2 products."""
    for size in (budget_floor.THETA_M, budget_floor.THETA_H):
        full = budget_floor.ud_update(size, range(size))
        pairs = size * (size - 1) // 2
        assert full == budget_floor.Operations(3 * pairs + 6 * size, 3 * pairs + size, size, 0)


def test_tables_are_not_written_without_their_markers() -> None:
    """GIVEN a document WHEN a marker is missing or twice there THEN nothing is replaced, and the document is named."""
    good = f"a\n{budget.START}\nold\n{budget.END}\nb\n"
    assert budget.insert(good, "new", "x.md") == f"a\n{budget.START}\nnew\n{budget.END}\nb\n"
    for bad in ("a\n", good + good, f"{budget.END}{budget.START}"):
        with pytest.raises(budget.BudgetError, match=r"x\.md"):
            budget.insert(bad, "new", "x.md")
