"""The binding of the C kernels, made by cffi when the package is built. A run never imports this module.

`compile_kernels` is called by `tools/hatch_build.py`, with the machine's compiler or the one in the `ziglang` wheel.
"""

from __future__ import annotations

import importlib.util
import os
import shlex
import shutil
import sys
import sysconfig
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

MODULE = "evedrop.model.kernels._compiled"
# Every operation is rounded on its own, as in numpy: no contraction to fused operations, and no fast-math. The last two only
# drop the bookkeeping of errors, which nobody reads, so that loops with a square root or a selection become vector code.
FLAGS = ("-O3", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math")


def compiler_environment() -> dict[str, str]:
    """Changes of the environment that select the compiler: none if the machine has one, else that of the `ziglang` wheel.

    Raises RuntimeError if there is neither.
    """
    machines = os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc"
    if shutil.which(shlex.split(machines)[0]) is not None:
        return {}
    if shutil.which("cc") is not None:
        return {"CC": "cc", "LDSHARED": "cc -shared"}
    if importlib.util.find_spec("ziglang") is None:
        raise RuntimeError(f"no C compiler: {machines} is not on the PATH, and the package ziglang is not installed")
    zig = f"{shlex.quote(sys.executable)} -m ziglang cc"
    return {"CC": zig, "LDSHARED": f"{zig} -shared"}


def compile_kernels(folder: Path) -> Path:
    """Compile the kernels; writes the extension module into a folder and returns its path.

    Raises an exception of any kind if there is no compiler, or it fails.
    """
    import cffi  # noqa: PLC0415 - only to build

    source = Path(__file__).parent / "source"
    binding = cffi.FFI()
    binding.cdef((source / "kernels.h").read_text(encoding="utf-8"))
    binding.set_source(
        MODULE,
        '#include <stdint.h>\n#include "kernels.h"',
        sources=[str((source / "kernels.c").resolve())],
        include_dirs=[str(source.resolve())],
        extra_compile_args=list(FLAGS),
        libraries=["m"],
    )
    with tempfile.TemporaryDirectory() as work, _environment(compiler_environment()):
        built = Path(binding.compile(tmpdir=work))
        # A running process may have mapped the old file: the new one takes its place, and does not overwrite it.
        target = folder / built.name
        shutil.copyfile(built, target.with_suffix(".new"))
        target.with_suffix(".new").replace(target)
    return target


@contextmanager
def _environment(changes: Mapping[str, str]) -> Iterator[None]:
    """Changes environment variables for a while."""
    before = dict(os.environ)
    os.environ.update(changes)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)
