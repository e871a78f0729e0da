"""A scenario has the same mistakes and warnings whatever the kernels are: those in C and those in numpy refuse the same arrays.

Source: docs/performance.md, kernels in C.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from evedrop.model.kernels.choice import EXTENSION
from evedrop.names import KERNELS_VARIABLE

ROOT = Path(__file__).parents[2]
READ = """
import contextlib
import io
import json
import tempfile
import warnings
from pathlib import Path

from evedrop.errors import EvedropError
from tests.fuzz.fuzzing import CORPUS
from tests.fuzz.mutation import Mutator
from tests.fuzz.readers import READERS

scenario = READERS["scenario"]
cases = {f"{path.parent.name}/{path.name}": (READERS[path.parent.name], path.read_bytes()) for path in CORPUS.glob("*/*")}
for number in range(60):
    mutator = Mutator(f"scenario/kernels/{number}", scenario.words())
    cases[f"scenario {number}"] = scenario, scenario.changed(mutator, number)
warnings.simplefilter("ignore")
messages = {}
for name, (reader, data) in sorted(cases.items()):
    with tempfile.TemporaryDirectory() as place, contextlib.redirect_stdout(io.StringIO()):
        try:
            read = reader.read(data, Path(place))
            messages[name] = read if reader is scenario else "read"
        except EvedropError as error:
            messages[name] = str(error).replace(place, "FOLDER")
print(json.dumps(messages, indent=1))
"""


def messages_with(kernels: str) -> list[str]:
    """What is said of every file of the corpus and of sixty changed scenarios, with these kernels."""
    command, environment = [sys.executable, "-c", READ], {**os.environ, KERNELS_VARIABLE: kernels}
    done = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.long
def test_the_corpus_is_read_the_same_with_either_kernels() -> None:
    """Every file is read or refused in our words in numpy, and in the same words as in C where that is built."""
    numpy = messages_with("numpy")
    assert len(numpy) > 80
    if importlib.util.find_spec(EXTENSION) is None:
        pytest.skip("the C kernels are not built: no compiler worked")
    assert messages_with("baseline") == numpy
