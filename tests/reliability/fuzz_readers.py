# SPDX-License-Identifier: Apache-2.0
"""Fuzz one reader, guided by coverage of its Python code: fuzz_readers.py READER [options of libFuzzer, such as
-runs=1000000 or -max_total_time=300]. Needs `pip install atheris`; without arguments it lists the readers.

libFuzzer prints coverage (`cov`), and writes what fails to crash-*; a failure belongs into a test. Damage within the
structure of msgpack, JSON, YAML, GLB, safetensors and SQLite takes turns with libFuzzer's own. Files are written for
each execution: up to ten times as fast with TMPDIR in /dev/shm, where libFuzzer's end leaves them. Besides a sample it
begins with the files of `tests/data/fuzz/READER`, each of which reaches other code. To keep what a run has found:

    fuzz_readers.py READER -max_total_time=300 FOUND
    fuzz_readers.py READER -merge=1 tests/data/fuzz/READER FOUND
"""

from __future__ import annotations

import random
import resource
import shlex
import signal
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FunctionType

import atheris

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent / "python")]

from locations import ROOM_FOLDERS, TESTS  # noqa: E402

sys.path.extend(ROOM_FOLDERS)

from readers import MOST_BYTES, READERS, STRUCTURES  # noqa: E402


def instrument(*packages: str) -> None:
    """Count coverage in all Python functions of packages that are imported, whoever has imported them.

    The import hook of Atheris does not see a package that is installed in editable mode.
    """
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] in packages:
            owners = [module, *(each for each in vars(module).values() if isinstance(each, type))]
            for function in (each for owner in owners for each in list(vars(owner).values())):
                if isinstance(function, FunctionType) and function.__module__ == name:
                    atheris.instrument_func(function)


def fuzz(name: str, folder: Path, options: list[str]) -> None:
    """Fuzz a reader in this process until libFuzzer ends it."""
    reader = READERS[name]
    sample = reader.make_sample(folder)
    reader.read(sample, folder)  # imports what it needs
    instrument("wiw", "json", "gzip", "jinja2")
    corpus = folder / "corpus"
    corpus.mkdir()
    (corpus / "sample").write_bytes(sample)

    def read(data: bytes) -> None:
        try:
            reader.read(data, folder)
        except MemoryError:
            pass
        except Exception as error:
            if not reader.refuses(error):
                raise

    def mutate(data: bytes, most: int, seed: int) -> bytes:
        if seed % 2:
            try:
                return STRUCTURES[reader.structure](bytes(data), random.Random(seed))[:most]
            except Exception:  # not well-formed, as most of the corpus is not
                pass
        return bytes(atheris.Mutate(data, most))

    mutator = {"custom_mutator": mutate} if reader.structure else {}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # A limit of the process's own: libFuzzer's counts what the parent had in memory when it started this process.
    resource.setrlimit(resource.RLIMIT_DATA, (MOST_BYTES, MOST_BYTES))
    kept = TESTS / "data" / "fuzz" / name
    places = [str(place) for place in (corpus, kept) if place.is_dir()]  # what is found goes into the first of all
    again = shlex.join([sys.executable, __file__, name])  # a shell runs it for -merge and -jobs
    atheris.Setup([again, "-timeout=60", "-rss_limit_mb=0", *options, *places], read, **mutator)
    atheris.Fuzz()


if __name__ == "__main__":
    if len(sys.argv) < 2 or sys.argv[1] not in READERS:
        sys.exit(f"usage: fuzz_readers.py READER [OPTION ...]; readers: {', '.join(READERS)}")
    with TemporaryDirectory() as own:
        fuzz(sys.argv[1], Path(own), sys.argv[2:])
