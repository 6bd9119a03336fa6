"""MISRA C:2012: what would let a new deviation in, or let the list of the known ones go stale."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.rules.compilers import ROOT, append, copy_firmware
from tools import misra

COMMITTED = (ROOT / misra.FINDINGS_PATH).read_text("utf-8")
DOCUMENT = (ROOT / misra.DOCUMENT_PATH).read_text("utf-8")
ONE_FILE = ["firmware/ecu/e2e.c"]


@pytest.fixture(autouse=True)
def _cppcheck() -> None:
    try:
        misra.cppcheck_version()
    except misra.MisraError as error:
        pytest.fail(str(error), pytrace=False)


@pytest.fixture(scope="module")
def findings() -> misra.Findings:
    """Everything in control/ and ecu/, by the release of cppcheck that made the committed list."""
    version = misra.cppcheck_version()
    if version != misra.known_version(COMMITTED):
        pytest.skip(f"the list was made by cppcheck {misra.known_version(COMMITTED)}, this is {version}")
    return misra.check()


def test_no_finding_is_new_or_gone(findings: misra.Findings) -> None:
    """GIVEN control/ and ecu/ WHEN checked for fixed and float THEN the findings are those that are committed."""
    assert misra.compare(findings, COMMITTED) == [], "mend it, or run `make rules` and give the reason in docs/misra.md"


def test_no_deviation_lacks_its_reason(findings: misra.Findings) -> None:
    """GIVEN the findings WHEN compared with docs/misra.md THEN each rule has its row, its counts and a reason."""
    assert misra.undocumented(findings, DOCUMENT) == []


def test_committed_list_and_document_do_not_contradict_each_other() -> None:
    """GIVEN the committed list WHEN read THEN its rules are the document's, whatever cppcheck is installed."""
    rules = {line.split()[0] for line in COMMITTED.splitlines() if not line.startswith("#")}
    assert rules == set(misra.deviations(DOCUMENT))


def spoiled(root: Path, code: str, sources: Sequence[str] = ONE_FILE) -> misra.Findings:
    """Findings in a copy with `code` at the end of its first source."""
    copy_firmware(root)
    append(root, sources[0], code)
    return misra.check(root, sources)


VIOLATIONS = {
    "7.1": "uint8_t octal(void) { return 017; }",
    "13.4": "bool assigned(int32_t x) { int32_t y; return (y = x) != 0; }",
    "15.1": "void jump(int32_t x) { if (x > 0) { goto end; } end: return; }",
    "16.3": "void fall(int32_t x) { switch (x) { case 0: e2e_crc(0, 0); case 1: break; default: break; } }",
    "17.2": "int32_t again(int32_t x) { return (x > 0) ? again(x - 1) : 0; }",
    "17.7": "void ignored(const uint8_t data[8]) { e2e_counter(data); }",
    "19.2": "union both { uint32_t word; uint8_t bytes[4]; };",
}
FUNCTIONS = {
    "7.1": "octal",
    "13.4": "assigned",
    "15.1": "jump",
    "16.3": "fall",
    "17.2": "again",
    "17.7": "ignored",
    "19.2": "both",
}


@pytest.fixture(scope="module")
def with_violations(tmp_path_factory: pytest.TempPathFactory) -> misra.Findings:
    """A copy with a violation of each rule, checked."""
    return spoiled(tmp_path_factory.mktemp("violations"), "\n".join(VIOLATIONS.values()))


@pytest.mark.parametrize("rule", VIOLATIONS)
def test_injected_violation_is_not_missed(with_violations: misra.Findings, rule: str) -> None:
    """GIVEN a violation in a copy WHEN checked THEN it is found in its function for both types, and is new."""
    place = (rule, ONE_FILE[0], FUNCTIONS[rule])
    assert set(with_violations[place]) == set(misra.SCALARS)
    complaints = misra.compare(with_violations, COMMITTED)
    assert any(line.startswith("new: " + " ".join(place)) for line in complaints)


def test_rule_without_a_row_does_not_pass(with_violations: misra.Findings) -> None:
    """GIVEN a rule that never occurred WHEN compared with the document THEN it is named."""
    assert f"rule 15.1 occurs and has no row in {misra.DOCUMENT_PATH}" in misra.undocumented(with_violations, DOCUMENT)


def test_lines_above_do_not_stir_the_findings(tmp_path: Path) -> None:
    """GIVEN a file with lines added on top WHEN checked THEN its findings are the same."""
    copy_firmware(tmp_path / "before")
    moved = copy_firmware(tmp_path / "after") / ONE_FILE[0]
    moved.write_text("/* one\n * two */\n\n" + moved.read_text("utf-8"), "utf-8")
    before = misra.check(tmp_path / "before", ONE_FILE)
    assert before and misra.check(tmp_path / "after", ONE_FILE) == before


def test_file_that_cannot_be_read_does_not_count_as_clean(tmp_path: Path) -> None:
    """GIVEN a file that is no C WHEN checked THEN the check fails."""
    with pytest.raises(misra.MisraError):
        spoiled(tmp_path, "void broken(void) { if (")


FINDINGS: misra.Findings = {
    ("9.3", "firmware/a.c", "f"): {"fixed": 1, "float": 1},
    ("10.1", "firmware/a.c", "g"): {"fixed": 2},
}
TEXT = misra.findings_text(FINDINGS, "2.10")
TABLE = "| rule | category | n | why |\n| 9.3 | required | 1 / 1 | because |\n| 10.1 | required | 2 / 0 | so |\n"


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (FINDINGS, []),
        (FINDINGS | {("10.1", "firmware/a.c", "h"): {"float": 1}}, ["new: 10.1 firmware/a.c h float=1"]),
        ({("9.3", "firmware/a.c", "f"): {"fixed": 1, "float": 1}}, ["gone: 10.1 firmware/a.c g fixed=2"]),
        (
            FINDINGS | {("10.1", "firmware/a.c", "g"): {"fixed": 3}},
            ["changed: 10.1 firmware/a.c g fixed=3, was fixed=2"],
        ),
        (
            FINDINGS | {("10.1", "firmware/a.c", "g"): {"fixed": 1}},
            ["changed: 10.1 firmware/a.c g fixed=1, was fixed=2"],
        ),
    ],
    ids=["same", "new", "gone", "more", "fewer"],
)
def test_difference_from_the_list_is_not_missed(changed: misra.Findings, said: list[str]) -> None:
    """GIVEN findings that differ from the list, either way, WHEN compared THEN the place is named."""
    assert misra.compare(changed, TEXT) == said
    assert misra.known_version(TEXT) == "2.10"


@pytest.mark.parametrize(
    ("document", "said"),
    [
        (TABLE, ""),
        (TABLE.replace("| 10.1 |", "| 10.2 |"), "rule 10.1 occurs and has no row"),
        (TABLE.replace("| 10.1 |", "| 10.2 |"), "rule 10.2 has a row in docs/misra.md and does not occur"),
        (TABLE.replace("2 / 0", "1 / 0"), "rule 10.1 occurs 2 / 0 times"),
        (TABLE.replace("because", ""), "rule 9.3 has no reason"),
        (TABLE.replace("required", "mandatory"), "rule 9.3 has no reason in docs/misra.md, or a category"),
    ],
    ids=["same", "no row", "row too many", "other count", "no reason", "mandatory"],
)
def test_contradiction_of_the_document_is_not_missed(document: str, said: str) -> None:
    """GIVEN a table that differs from the findings WHEN compared THEN the rule is named."""
    complaints = misra.undocumented(FINDINGS, document)
    assert any(line.startswith(said) for line in complaints) if said else complaints == []
    if "other" in said or "times" in said:
        assert misra.undocumented(FINDINGS, misra.with_totals(FINDINGS, document)) == []


def test_line_is_not_given_to_the_wrong_function() -> None:
    """GIVEN each kind of declaration WHEN its lines are looked up THEN they belong to its name."""
    text = """/* text ( */
#include "ecu/a.inc"
#define TWICE(x) \\
    ((x) * 2)
enum joint { SWING, WRIST };
struct arm {
    int a, b;
};
typedef struct {
    int c;
} inverse;
static const int TABLE[2][3] = {
    {1, 2},
};

static struct arm arm_of(int x,
                         int y)
{
    if (x) {
        return f(y);
    }
}
int prototype(int a);
_Static_assert(1, "x");"""
    names = ["-", "ecu/a.inc", *["TWICE"] * 2, "joint", *["arm"] * 3, *["inverse"] * 3, *["TABLE"] * 3, "-"]
    assert misra.line_owners(text) == [*names, *["arm_of"] * 7, "prototype", "_Static_assert"]
