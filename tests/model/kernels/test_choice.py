"""Which kernels are used: as the environment says, or what could be built; and that users are told."""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

from evedrop.cli.console import ProgressLine
from evedrop.model.kernels import binding, choice
from evedrop.names import KERNELS_VARIABLE
from evedrop.system.environment import own_environment

MISSING = "import sys; sys.modules['evedrop.model.kernels._compiled'] = None; "
"""As if the extension module had not been built."""
SELFTEST = "import sys; from evedrop.cli.main import main; sys.exit(main(['selftest']))"
MONTECARLO = SELFTEST.replace("selftest", "montecarlo")
"""A command whose module imports the kernels before its options are read."""
SHOWN = "from evedrop.model.kernels.choice import KERNELS; print(KERNELS)"


def python(code: str, kernels: str | None = None) -> subprocess.CompletedProcess[str]:
    """Run code in an interpreter of its own."""
    environment = {name: value for name, value in os.environ.items() if name != KERNELS_VARIABLE}
    if kernels is not None:
        environment[KERNELS_VARIABLE] = kernels
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=120)


@pytest.mark.thorough
def test_the_selftest_passes_in_numpy_and_says_so() -> None:
    """The golden digests do not depend on the kernels."""
    done = python(SELFTEST, "numpy")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "kernels         numpy, as EVEDROP_KERNELS says" in done.stdout


@pytest.mark.long
def test_the_selftest_says_that_nothing_was_built() -> None:
    """The same where the extension module is missing."""
    done = python(MISSING + SELFTEST)
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"kernels         {choice.FALLBACK}" in done.stdout


def test_kernels_that_cannot_be_had_are_refused() -> None:
    """An unknown name, and C where it was not built, with a way out."""
    for code, kernels, message in (
        (SELFTEST, "fortran", "EVEDROP_KERNELS is 'fortran'; expected one of numpy, baseline"),
        (MONTECARLO, "fortran", "evedrop: EVEDROP_KERNELS is 'fortran'; expected one of numpy, baseline"),
        (MISSING + SELFTEST, "avx2", "EVEDROP_KERNELS is avx2, but the C kernels cannot be loaded"),
    ):
        done = python(code, kernels)
        assert done.returncode == 2
        assert message in done.stderr
        assert "Traceback" not in done.stderr


def test_an_instruction_set_may_be_asked_for() -> None:
    """The baseline works on every processor for which the kernels were built."""
    pytest.importorskip(choice.EXTENSION, reason="the C kernels are not built: no compiler worked")
    assert python(SHOWN, "baseline").stdout == "C (baseline)\n"


def test_processes_of_a_run_use_the_same_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """The variable is among those that they are given."""
    monkeypatch.setenv(KERNELS_VARIABLE, "numpy")
    assert own_environment()[KERNELS_VARIABLE] == "numpy"


@pytest.mark.parametrize(("kernels", "warned"), [(choice.FALLBACK, True), ("C (avx2)", False), ("numpy, as", False)])
def test_a_run_begins_with_a_warning_if_there_are_no_kernels(
    kernels: str, warned: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Only if numpy was not asked for."""
    monkeypatch.setattr(choice, "KERNELS", kernels)
    with ProgressLine(10, "slots"):
        pass
    errors = capsys.readouterr().err
    assert ("warning: the kernels are numpy, because the C kernels are not built" in errors) == warned


def test_without_any_compiler_the_build_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Neither a compiler on the path nor the package ziglang."""
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(RuntimeError, match=r"no C compiler: .* is not on the PATH, and the package ziglang"):
        binding.compiler_environment()


def test_zigs_compiler_takes_the_place_of_a_missing_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """If its package is installed."""
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr("importlib.util.find_spec", lambda _: object())
    assert binding.compiler_environment()["CC"].endswith(" -m ziglang cc")


def test_a_build_replaces_only_the_kernels_of_its_own_python(tmp_path: Path) -> None:
    """Environments of several Pythons may share a checkout; a build that fails leaves no old kernels of its own."""
    kernels = tmp_path / "emulator" / "evedrop" / "model" / "kernels"
    kernels.mkdir(parents=True)
    (kernels / "binding.py").write_text("def compile_kernels(folder):\n    raise RuntimeError('no compiler')\n")
    own, other = (
        f"_compiled.{sys.implementation.cache_tag}-x86_64-linux-gnu.so",
        "_compiled.cpython-39-x86_64-linux-gnu.so",
    )
    for name in (own, other):
        (kernels / name).touch()
    hook = runpy.run_path(str(Path(__file__).parents[3] / "tools" / "hatch_build.py"))["KernelsHook"]
    builder = Mock()
    hook(str(tmp_path), {}, None, None, str(tmp_path), "wheel", builder).initialize("editable", {})
    assert [path.name for path in kernels.glob("_compiled.*")] == [other]
    assert "no compiler" in builder.display_warning.call_args.args[0]
