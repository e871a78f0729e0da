"""Builds the C kernels with the package, and makes the description of the package from README.md.

Where no compiler works, the package is installed without them and says so; or the build fails, if the environment variable
`EVEDROP_KERNELS_REQUIRED` is 1, as it must be for a wheel that is published for a platform.
"""

from __future__ import annotations

import importlib.util
import os
import re
import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface

_KERNELS = Path("emulator/evedrop/model/kernels")
_REQUIRED = "EVEDROP_KERNELS_REQUIRED"


class ReadmeHook(MetadataHookInterface):
    """Makes README.md the description of the package, which is shown where the repository's files are not."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set `readme`."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        metadata["readme"] = {"content-type": "text/markdown", "text": without_files(text)}


def without_files(text: str) -> str:
    """Markdown without the pictures and links that lead to files: of a link, its words stay."""
    text = re.sub(r"^!\[[^]]*\]\((?!https?:)[^)]*\)\n+", "", text, flags=re.MULTILINE)
    return re.sub(r"\[([^]]*)\]\((?!https?:)[^)]*\)", r"\1", text)


class KernelsHook(BuildHookInterface):
    """Compiles the kernels, into the checkout for an editable install, and into the wheel otherwise."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the extension module before the files of the package are collected.

        Raises RuntimeError if it cannot be built and must be, ValueError if the variable that says so is neither 0 nor 1.
        """
        if self.target_name != "wheel":
            return
        required = os.environ.get(_REQUIRED, "0")
        if required not in {"0", "1"}:
            raise ValueError(f"{_REQUIRED} is {required!r}; expected 1 or 0, or leave it out")
        folder = Path(self.root) / (_KERNELS if version == "editable" else "build/kernels")
        folder.mkdir(parents=True, exist_ok=True)
        # Only this Python's own: environments of several Pythons may share a checkout.
        for old in folder.glob(f"_compiled.{sys.implementation.cache_tag}-*"):
            old.unlink()
        try:
            built = _binding(Path(self.root)).compile_kernels(folder)
        except Exception as error:
            if required == "1":
                raise RuntimeError(
                    f"the C kernels were not built, and {_REQUIRED} is 1: {error}; install a C compiler, or leave the "
                    "variable out for a package that uses numpy in their place"
                ) from error
            self.app.display_warning(f"the C kernels were not built, numpy will be used: {error}")
            return
        if version != "editable":
            build_data["force_include"][str(built)] = f"evedrop/model/kernels/{built.name}"
            build_data["pure_python"] = False
            build_data["infer_tag"] = True


def _binding(root: Path) -> Any:
    """The module `evedrop.model.kernels.binding`, of a package that is not installed yet."""
    spec = importlib.util.spec_from_file_location("kernels_binding", root / _KERNELS / "binding.py")
    if spec is None or spec.loader is None:
        raise RuntimeError(f"{root / _KERNELS} has no binding.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
