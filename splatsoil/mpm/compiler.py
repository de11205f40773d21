"""How the solver's kernels are compiled for a CPU."""

from __future__ import annotations

from typing import Any

OPTIONS: dict[str, Any] = {
    "cpu_compiler_flags": "-march=native -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000"
    " -mllvm=-slp-recursion-max-depth=12"
}
"""Warp's own but for how far LLVM looks for what one instruction can do at once: its default, three times Warp's. The
same bits, a tenth sooner (substeps' stress and exchanges alike)."""
