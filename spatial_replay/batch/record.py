"""Conditions of a run, which its table stores for later explanations."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from spatial_replay.batch.rows import ResultName, Task
from spatial_replay.batch.store import EXPLANATION
from spatial_replay.batch.suite import Conditions
from spatial_replay.logs.remote import is_address
from spatial_replay.spec.load import SpecificationText

if TYPE_CHECKING:
    import pyarrow as pa


_RECORD: Final = b"spatial_replay"
"""Key of the record in the metadata of a table."""
Explanation: TypeAlias = tuple[Any, ...]
"""The values of the columns `EXPLANATION` in a row."""


@dataclass(frozen=True, slots=True)
class RunRecord:
    """Conditions and specifications of a run.

    Attributes:
        folder: base of the names of logs.
        cases: conditions and specification texts of each case, by the name of the case.
    """

    folder: str
    cases: Mapping[str, Mapping[str, Any]]

    @classmethod
    def of(cls, table: pa.Table) -> RunRecord:
        """Return the record of a table. A table without a record gives a record without cases."""
        data = (table.schema.metadata or {}).get(_RECORD, b'{"folder": "", "cases": {}}')
        return cls(**json.loads(data))

    def store_in(self, table: pa.Table) -> pa.Table:
        """Return a table with this record."""
        record = json.dumps({"folder": self.folder, "cases": self.cases})
        return table.replace_schema_metadata({**(table.schema.metadata or {}), _RECORD: record.encode()})

    def files(self, case: str) -> list[str]:
        """Return the names of the specification files of a case."""
        return list(self.cases[case]["files"])

    def result_name(self, case: str, file: str, spec: str, object_name: str | None) -> ResultName:
        """Return the name of a result in the task of its log."""
        return self.files(case).index(file), spec, object_name

    def task(self, case: str, log: str) -> Task:
        """Return the task of the run that evaluated a log.

        Args:
            log: name of the log in the table.
        """
        path = log if is_address(log) else str(Path(self.folder) / log)
        texts = tuple(SpecificationText(*text) for text in self.cases[case]["files"].values())
        conditions = self.cases[case]["conditions"]
        return Task(path, texts, Conditions(**{name: _frozen(value) for name, value in conditions.items()}))


def _frozen(value: Any) -> Any:
    """Return a value of JSON with tuples instead of lists."""
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


def recorded_conditions(conditions: Conditions) -> dict[str, Any]:
    """Return conditions as values for JSON, with the absolute path of a mapping."""
    mapping = conditions.mapping
    if mapping is not None and not is_address(mapping):
        mapping = str(Path(mapping).absolute())
    return asdict(replace(conditions, mapping=mapping))


def with_explanations(table: pa.Table, explanations: Mapping[int, Explanation]) -> pa.Table:
    """Return a table with explanations, given by the indices of their rows."""
    import pyarrow as pa

    for column_number, name in enumerate(EXPLANATION if explanations else ()):
        values = table.column(name).to_pylist()
        for row_index, explanation in explanations.items():
            values[row_index] = explanation[column_number]
        column_index = table.schema.get_field_index(name)
        field = table.schema.field(column_index)
        table = table.set_column(column_index, field, pa.array(values, field.type))
    return table
