"""Read and compile a file of unit tests with the declarations that its tests use."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.error_collector import ErrorCollector
from fieldtwin.plc.source_files import is_test_file, source_files, source_paths
from fieldtwin.plc.st.compiler.compile import CompiledUnit, compile_unit
from fieldtwin.plc.st.coverage.places import Place
from fieldtwin.plc.st.coverage.probes import Probes
from fieldtwin.plc.st.dialects import STANDARD, Dialect
from fieldtwin.plc.st.project import read_with
from fieldtwin.plc.st.tcunit_suites import is_suite
from fieldtwin.plc.st.unit_tests.assertions import TranslatedTest
from fieldtwin.plc.st.unit_tests.blocks import programs_as_blocks
from fieldtwin.plc.st.unit_tests.run import Failed, TestResult, run_tests
from fieldtwin.plc.st.unit_tests.tcunit import suites_as_programs
from fieldtwin.plc.st.unit_tests.translate import tests_as_programs


@dataclass
class Suite:
    """The tests of a file, compiled."""

    path: Path
    unit: CompiledUnit
    tests: list[TranslatedTest]
    _probes: Probes
    _unused: Probes
    """The probes of the POUs that no test uses: their places count as not executed."""
    _recorded: set[Any]

    def run(self, failed: Failed | None = None) -> Iterator[TestResult]:
        """Run each test. `failed` is called at the first failure of each assertion."""
        yield from run_tests(self.unit, self.tests, self._recorded, failed)

    def coverage(self) -> dict[Place, bool]:
        """Return each place of the tested files, and whether a test has executed it."""
        return {
            **self._unused.result(set(), {}),
            **self._probes.result(self._recorded, self.unit.probed),
        }


def load_suite(
    path: Path, dialect: Dialect = STANDARD, libraries: tuple[Path, ...] = (), *, coverage: bool = True
) -> Suite:
    """Read a file of tests. They may use the declarations of the other files in its folder and below it, and of
    `libraries`.

    Without `coverage` the code has no probes, as in a plant.

    Raises `FileInvalid` for the first error, with the others.
    """
    beside = tuple(_beside(path))
    unit, others = read_with(path, beside, libraries, dialect, programs_as_blocks)
    if not unit.tests and not any(map(is_suite, unit.pous)):
        raise FileInvalid("no test in this file", path=str(path), expected="TEST 'name' ... END_TEST")
    probes, unused = Probes(), Probes()
    if coverage:
        own = {str(path)} if is_test_file(path) or not unit.tests else set()
        left_out = {*own, *(one.pos.path for one in unit.pous if is_test_file(Path(one.pos.path)))}
        left_out |= {str(file) for library in libraries for file in source_files(library)} - set(map(str, beside))
        for other in others:
            unused.insert(other, left_out)
        unit = probes.insert(unit, left_out)
    numbers, errors = count(1), ErrorCollector()
    unit, tests = tests_as_programs(unit, numbers, errors)
    unit, cyclic = suites_as_programs(unit, numbers, errors)
    errors.raise_all()
    tests += cyclic
    used = {declared.pos.path for declared in (*unit.types, *unit.globals, *unit.pous)}
    compiled = compile_unit(unit, str(path), tuple(dict.fromkeys((str(path), *sorted(used)))), dialect)
    return Suite(path, compiled, tests, probes, unused, set())


def _beside(path: Path) -> Iterator[Path]:
    """Return the other source files in the folder of `path`, then those in folders below it, both sorted."""
    folder = path.parent
    for file in sorted(source_paths(folder), key=lambda one: (one.parent != folder, one)):
        if file != path and (file.parent == folder or not is_test_file(file)):
            yield file
