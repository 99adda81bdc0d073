"""Copy datasets.yaml from the repository root into the built package.

setuptools only packs files below a package folder; everything else about the build is in pyproject.toml.
"""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildWithRegistry(build_py):
    """``build_py`` that also ships the registry."""

    def run(self) -> None:
        """Build as usual, then copy the registry beside the package's modules."""
        super().run()
        if not self.editable_mode:
            target = Path(self.build_lib) / "lagbench" / "datasets.yaml"
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(Path(__file__).parent / "datasets.yaml", target)


setup(cmdclass={"build_py": BuildWithRegistry})
