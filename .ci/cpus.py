#!/usr/bin/env python3
"""Runs a command as it would run on another CPU: its libraries take that one's instructions.

    .ci/cpus.py list                  # the CPUs, and which of them this one can stand in for
    .ci/cpus.py run zen -- make run
    .ci/cpus.py all -- make test      # one after another

Results that follow from rounding come out otherwise then, as they do on such a machine. What this
CPU cannot stand in for is skipped: `run` ends with 77, `all` goes on. Needs nothing but Python.
"""

import os
import platform
import shlex
import subprocess
import sys
from pathlib import Path

SKIPPED = 77
CACHES = Path(__file__).resolve().parents[1] / ".numba"

# Instructions that numpy and glibc shall do without; the names of numpy 2.4.
NO_AVX512 = {
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
}
NO_FMA = {
    "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL AVX512_SPR",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA",
}

# What each needs of the CPU at hand, and what its libraries are told: PyTorch (ATEN, MKL, ONEDNN),
# numpy and scipy (OPENBLAS, NPY), the compiled kernels (NUMBA). Threads differ, too.
CPUS = {
    "nehalem": (
        "sse4_2",
        {
            "ATEN_CPU_CAPABILITY": "default",
            "MKL_CBWR": "COMPATIBLE",
            "ONEDNN_MAX_CPU_ISA": "SSE41",
            "OPENBLAS_CORETYPE": "Nehalem",
            "NUMBA_CPU_NAME": "generic",
            "OMP_NUM_THREADS": "1",
            **NO_FMA,
        },
    ),
    "sandybridge": (
        "avx",
        {
            "ATEN_CPU_CAPABILITY": "default",
            "MKL_ENABLE_INSTRUCTIONS": "SSE4_2",
            "ONEDNN_MAX_CPU_ISA": "AVX",
            "OPENBLAS_CORETYPE": "Sandybridge",
            "NUMBA_CPU_NAME": "sandybridge",
            "OMP_NUM_THREADS": "2",
            **NO_FMA,
        },
    ),
    "haswell": (
        "avx2 fma bmi2",
        {
            "ATEN_CPU_CAPABILITY": "avx2",
            "MKL_ENABLE_INSTRUCTIONS": "AVX2",
            "ONEDNN_MAX_CPU_ISA": "AVX2",
            "OPENBLAS_CORETYPE": "Haswell",
            "NUMBA_CPU_NAME": "haswell",
            "OMP_NUM_THREADS": "1",
            **NO_AVX512,
        },
    ),
    "zen": (
        "avx2 fma bmi2",
        {
            "ATEN_CPU_CAPABILITY": "avx2",
            "MKL_CBWR": "AVX2",
            "ONEDNN_MAX_CPU_ISA": "AVX2",
            "OPENBLAS_CORETYPE": "Zen",
            "NUMBA_CPU_NAME": "znver2",
            # Those that no other maker has.
            "NUMBA_CPU_FEATURES": "-sse4a,-clzero,-mwaitx,-wbnoinvd,-rdpid,-clwb",
            "OMP_NUM_THREADS": "2",
            **NO_AVX512,
        },
    ),
    "skylake": (
        "avx512f avx512bw avx512cd avx512dq avx512vl",
        {
            "ATEN_CPU_CAPABILITY": "avx512",
            "MKL_ENABLE_INSTRUCTIONS": "AVX512",
            "ONEDNN_MAX_CPU_ISA": "AVX512_CORE",
            "OPENBLAS_CORETYPE": "SkylakeX",
            "NUMBA_CPU_NAME": "skylake-avx512",
            "OMP_NUM_THREADS": "1",
        },
    ),
}


def here() -> set[str] | None:
    """Instructions of the CPU at hand; None where they cannot be told."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return None
    return set(next((line for line in lines if line.startswith("flags")), "").split())


def lacking(name: str) -> str:
    """Why this machine cannot stand in for a CPU; empty where it can."""
    flags = here()
    if platform.machine() not in ("x86_64", "AMD64") or flags is None:
        return f"{name}: skipped, since it takes Linux on an x86-64 CPU to stand in for it."
    missing = [flag for flag in CPUS[name][0].split() if flag not in flags]
    return f"{name}: skipped, since this CPU lacks {', '.join(missing)}." if missing else ""


def environment(name: str) -> dict[str, str]:
    """Variables of a command that shall run as on that CPU."""
    # Kernels compiled for another CPU are not for this one.
    cache = {"NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(CACHES / name)}
    return cache | CPUS[name][1]


def run(name: str, command: list[str]) -> int:
    reason = lacking(name)
    if reason:
        print(reason, file=sys.stderr, flush=True)
        return SKIPPED
    print(f"{name}: {shlex.join(command)}", file=sys.stderr, flush=True)
    try:
        return subprocess.run(command, env=os.environ | environment(name)).returncode
    except FileNotFoundError:
        print(f"{command[0]} is no command.", file=sys.stderr)
        return 127


def main(arguments: list[str]) -> int:
    words, command = arguments, []
    if "--" in arguments:
        place = arguments.index("--")
        words, command = arguments[:place], arguments[place + 1 :]
    if words == ["list"] and not command:
        for name in CPUS:
            print(
                lacking(name) or f"{name}: {shlex.join(map('='.join, environment(name).items()))}"
            )
        return 0
    if len(words) == 2 and words[0] == "run" and command:
        if words[1] in CPUS:
            return run(words[1], command)
        print(f"{words[1]} is no CPU known here; those are {', '.join(CPUS)}.", file=sys.stderr)
        return 2
    if words == ["all"] and command:
        codes = {name: run(name, command) for name in CPUS}
        for name, code in codes.items():
            said = {0: "passed", SKIPPED: "skipped"}.get(code, f"failed ({code})")
            print(f"{name}: {said}", file=sys.stderr)
        return int(not set(codes.values()) <= {0, SKIPPED})
    print(__doc__, file=sys.stderr)
    print(f"CPUs: {', '.join(CPUS)}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
