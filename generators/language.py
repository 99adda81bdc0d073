"""The language of the kernels, from the engine that is installed.

Taichi and Quadrants, its fork, have the same language and make the same bits.
"""

from __future__ import annotations

import os
import warnings
from typing import TYPE_CHECKING

from lagbench.errors import require
from lagbench.work.engine import find_engine

ENGINE = find_engine()
"""The package that compiles the kernels: ``taichi`` or ``quadrants``."""

# As it is imported, an engine greets on stdout, which would spoil `--json`, and Taichi
# asks the network for a newer version.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
os.environ.setdefault("ENABLE_QUADRANTS_HEADER_PRINT", "0")
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")
# Quadrants says so of its own kernel that fills a field.
warnings.filterwarnings("ignore", "cannot create weak reference", UserWarning)

if TYPE_CHECKING:
    import taichi as ti
    from taichi import f32, f64, i32, i64
    from taichi.math import mat2, mat3, vec2, vec3, vec4
else:
    ti = require(ENGINE, extra="generate")
    f32 = ti.f32
    f64 = ti.f64
    i32 = ti.i32
    i64 = ti.i64
    mat2 = ti.math.mat2
    mat3 = ti.math.mat3
    vec2 = ti.math.vec2
    vec3 = ti.math.vec3
    vec4 = ti.math.vec4

__all__ = [
    "ENGINE",
    "f32",
    "f64",
    "i32",
    "i64",
    "mat2",
    "mat3",
    "ti",
    "vec2",
    "vec3",
    "vec4",
]
