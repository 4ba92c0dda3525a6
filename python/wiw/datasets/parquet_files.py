# SPDX-License-Identifier: Apache-2.0
"""Parquet files of training data: whole or absent, with checksums, readable by Hugging Face's `datasets`."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any

from wiw.errors import DependencyError, FileError
from wiw.files import atomic_file

MANIFEST = "manifest.json"
"""Name of the file in a folder that says what was requested."""
KEY = b"wiw"
"""Key of the Parquet metadata, which are JSON."""


def require_pyarrow(what: str) -> None:
    """Check that files can be read and written.

    Args:
        what: what the files are, for the message.

    Raises:
        DependencyError: pyarrow is not installed.
    """
    from importlib.util import find_spec

    if find_spec("pyarrow") is None:
        raise DependencyError(f"{what} are Parquet files, which need pyarrow: pip install 'wiw[export]'")


def image_type() -> Any:
    """Return the Arrow type of a picture column, in the layout of `datasets`."""
    import pyarrow as pa

    return pa.struct([("bytes", pa.binary()), ("path", pa.string())])


def image_values(pictures: Sequence[bytes | None]) -> list[dict[str, Any] | None]:
    """Return encoded pictures as values of a picture column; None stays None."""
    return [None if data is None else {"bytes": data, "path": None} for data in pictures]


def build_schema(types: Mapping[str, Any], facts: Mapping[str, Any]) -> Any:
    """Return an Arrow schema whose metadata hold `facts` and say how `datasets` decodes each column."""
    import pyarrow as pa

    features = {"info": {"features": {name: _feature(kind) for name, kind in types.items()}}}
    metadata = {KEY: json.dumps(facts).encode(), b"huggingface": json.dumps(features).encode()}
    return pa.schema(list(types.items()), metadata=metadata)


def _feature(kind: Any) -> dict[str, Any]:
    import pyarrow as pa

    if pa.types.is_struct(kind):
        return {"_type": "Image"}
    if pa.types.is_fixed_size_list(kind):
        return {"feature": _feature(kind.value_type), "length": kind.list_size, "_type": "Sequence"}
    return {"dtype": {"double": "float64"}.get(str(kind), str(kind)), "_type": "Value"}


def write_row_groups(path: Path, schema: Any, tables: Iterable[Any], **options: Any) -> None:
    """Write a file with one row group per table; it is there whole or not at all.

    Args:
        path: of the file; what it held is replaced.
        schema: of the tables.
        tables: taken one by one.
        **options: of `pyarrow.parquet.ParquetWriter`.

    Raises:
        FileError: it cannot be written, for instance because the disk is full.
    """
    from pyarrow import parquet

    with (
        atomic_file(path) as draft,
        parquet.ParquetWriter(draft, schema, write_page_checksum=True, **options) as file,
    ):
        for table in tables:
            file.write_table(table, row_group_size=max(1, len(table)))


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file."""
    digest = sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


class RowGroupFile:
    """A file that is read row group by row group.

    Args:
        path: of the file.
        form: format number that it must have.
        what: what is in it, for messages.
        source: the command that writes such files, for messages, where the user has named the file, which may be any;
            None for one of a folder that wiw has written.

    Raises:
        FileError: it does not exist, is damaged, or is of another format.
    """

    def __init__(self, path: Path, form: int, what: str, source: str | None = None) -> None:
        from pyarrow import ArrowException, parquet

        self.path, self._what, self._source = path, what, source
        try:
            self._metadata = parquet.read_metadata(path)
            self.facts: dict[str, Any] = dict(json.loads(self._metadata.metadata[KEY]))
        except FileNotFoundError as error:
            if source is not None:
                raise FileError(f"{path} does not exist; expected a file of {what}, which {source} writes") from error
            raise FileError(f"{path} is missing; recreate it by repeating the `wiw collect` command") from error
        except (OSError, ArrowException, KeyError, TypeError, ValueError, RecursionError) as error:
            raise self.build_damage_error(error) from error
        if self.facts.get("format") != form:
            raise FileError(f"{path}: expected {what} of format {form}, got {self.facts.get('format')}")

    def __len__(self) -> int:
        return int(self._metadata.num_row_groups)

    def read(self, index: int, columns: Sequence[str] | None = None) -> Any:
        """Return a row group as an Arrow table; nothing else of the file is read.

        Raises:
            FileError: the file is damaged.
        """
        from pyarrow import ArrowException, parquet

        with (
            self.blame_damage(OSError, ArrowException),
            parquet.ParquetFile(self.path, metadata=self._metadata, page_checksum_verification=True) as file,
        ):
            return file.read_row_group(index, columns=columns)

    @contextmanager
    def blame_damage(self, *more: type[Exception]) -> Iterator[None]:
        """Turn errors from unexpected content into a FileError.

        Args:
            more: other errors by which damage shows.

        Raises:
            FileError: the file is damaged.
        """
        usual = (AttributeError, LookupError, TypeError, ValueError, OverflowError, RecursionError)
        signs: tuple[type[Exception], ...] = (*usual, *more)
        try:
            yield
        except signs as error:
            raise self.build_damage_error(error) from error

    def build_damage_error(self, error: Exception) -> FileError:
        """Return an error that says what to do about a damaged file."""
        if self._source is not None:
            return FileError(
                f"{self.path}: expected a complete file of {self._what}, which {self._source} writes, got another or a "
                f"damaged one ({error}); name one that it has written, or write it anew"
            )
        return FileError(
            f"{self.path}: expected a complete file of {self._what}, got a damaged one ({error}); delete it and "
            "recreate it by repeating the `wiw collect` command"
        )
