"""Tidy tables: named columns of equal length, light enough for the base install."""

import csv
import html
import itertools
import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sd_friction_env.extras import extra
from sd_friction_env.storage import LARGEST_ARCHIVE, atomic_file, read_text

_SHOWN_ROWS = 10


class Table(dict[str, NDArray[Any]]):
    """Columns by name, each of shape (n,); ``metadata`` says where they come from."""

    def __init__(self, columns: Mapping[str, ArrayLike], metadata: Mapping[str, Any] | None = None) -> None:
        super().__init__({name: np.asarray(values) for name, values in columns.items()})
        self.metadata = dict(metadata or {})
        lengths = {name: len(values) for name, values in self.items()}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"columns must have one length, got {lengths}")

    @classmethod
    def from_rows(cls, rows: Sequence[Mapping[str, Any]], metadata: Mapping[str, Any] | None = None) -> "Table":
        """Return rows as a table with the columns of all of them, in that order; NaN where a row has no value."""
        names = dict.fromkeys(name for row in rows for name in row)
        return cls({name: [row.get(name, math.nan) for row in rows] for name in names}, metadata)

    @classmethod
    def stacked(cls, tables: Iterable[Mapping[str, Any]], metadata: Mapping[str, Any] | None = None) -> "Table":
        """Return tables of the same columns, one below the other."""
        parts = list(tables)
        return cls({name: np.concatenate([part[name] for part in parts]) for name in parts[0]}, metadata)

    def labelled(self, **values: Any) -> "Table":
        """Return the table with a column in front for each of the values, which is the same in all rows."""
        labels = {name: np.full(self.n_rows, value) for name, value in values.items()}
        return Table(labels | dict(self), self.metadata)

    def __repr__(self) -> str:
        return f"Table of {self.n_rows} rows: {', '.join(self)}"

    def _repr_html_(self) -> str:
        """Return the first rows as HTML, for notebooks."""
        head = "".join(f"<th>{html.escape(name)}</th>" for name in self)
        rows = [
            "".join(f"<td>{html.escape(_short(value))}</td>" for value in row.values())
            for row in itertools.islice(self.rows(), _SHOWN_ROWS)
        ]
        body = "".join(f"<tr>{row}</tr>" for row in rows)
        rest = f"<p>{len(rows)} of {self.n_rows} rows</p>" if self.n_rows > len(rows) else ""
        return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{rest}"

    @property
    def n_rows(self) -> int:
        """The number of rows."""
        return len(next(iter(self.values()))) if self else 0

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield each row as a dictionary of plain Python values."""
        columns = {name: values.tolist() for name, values in self.items()}
        for i in range(self.n_rows):
            yield {name: values[i] for name, values in columns.items()}

    def to_dataframe(self) -> Any:
        """Return a pandas DataFrame.

        Raises:
            ImportError: if pandas is not installed.
        """
        with extra("plot"):
            import pandas as pd
        return pd.DataFrame(dict(self))

    def to_csv(self, path: str | os.PathLike[str]) -> None:
        """Write the table, whole or not at all: comment lines "# key: value" with the metadata, a header, the rows."""
        with atomic_file(path) as file:
            self.write(file)

    def write(self, file: IO[str]) -> None:
        """Write what :meth:`to_csv` writes to an open text file."""
        for key, value in self.metadata.items():
            file.write(f"# {key}: {value if isinstance(value, str) else json.dumps(value)}\n")
        file.write(",".join(self) + "\n")
        for row in self.rows():
            file.write(",".join(_cell(value) for value in row.values()) + "\n")

    @classmethod
    def from_csv(cls, path: str | os.PathLike[str]) -> "Table":
        """Read what :meth:`to_csv` wrote; columns of numbers become float64.

        Raises:
            OSError: if the file cannot be read.
            ValueError: if it is not such a table.
        """
        lines = read_text(path, LARGEST_ARCHIVE).splitlines()
        metadata = {}
        while lines and lines[0].startswith("# "):
            key, _, value = lines.pop(0)[2:].partition(": ")
            metadata[key] = value
        cells = list(csv.reader(lines))
        if not cells or any(len(row) != len(cells[0]) for row in cells):
            raise ValueError(f"{os.fspath(path)!r} is not a table: a header and rows of one length are wanted")
        columns: dict[str, ArrayLike] = {}
        for name, *values in zip(*cells, strict=True):
            try:
                columns[name] = np.array([float(value) for value in values])
            except ValueError:
                columns[name] = np.array(values)
        return cls(columns, metadata)


def _short(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _cell(value: Any) -> str:
    if isinstance(value, str):
        return '"' + value.replace('"', '""') + '"' if any(mark in value for mark in ',"\n') else value
    return repr(value)
