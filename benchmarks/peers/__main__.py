"""Time other programs and this one on the same work, one after another on one device.

    python -m benchmarks.peers --out peers.json
    python -m benchmarks.peers --out peers.json --python openpi=/envs/openpi/bin/python
    python -m benchmarks.peers --size tiny --out tiny.json    # on a CPU

Each case runs alone in a process of its program's interpreter (`--python`), with its program's
folders in front of the module search path (`--path`). `studies/performance/peers.md` explains the
set-up.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from benchmarks.measuring import print_table
from benchmarks.peers import report
from benchmarks.peers.cases import INSTALL, TABLES, Case, cases

ROOT = Path(__file__).resolve().parents[2]
_SETTINGS = "size", "warmup", "steps", "compile", "denoise_steps"


def named(text: str) -> tuple[str, str]:
    """Parse "program=value"."""
    program, separator, value = text.partition("=")
    if program not in INSTALL or not separator or not value:
        raise argparse.ArgumentTypeError(
            f"expected PROGRAM=VALUE with one of {', '.join(INSTALL)}, got {text!r}"
        )
    return program, value


def environment(case: Case, options: argparse.Namespace, cache: str) -> dict[str, str]:
    """Return the environment of a case's process.

    Compiled JAX programs are kept for the run, so that a repeated case need not compile again.
    JAX may use almost all of the memory. Tiny sizes run on one thread, with little optimization.
    """
    paths = [dict(options.path).get(case.program), os.environ.get("PYTHONPATH")]
    defaults = {"XLA_PYTHON_CLIENT_MEM_FRACTION": "0.95"}
    if not case.table.startswith("stack"):  # whose compilation is measured
        defaults |= {"JAX_COMPILATION_CACHE_DIR": cache}
    if options.size == "tiny":
        defaults |= {"OMP_NUM_THREADS": "1", "JAX_PLATFORMS": "cpu", "CUDA_VISIBLE_DEVICES": ""}
        defaults |= {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    search = {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    return {**defaults, **os.environ, **search}


def run(case: Case, options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Run one case and return its result, or its error as one line of text."""
    file = folder / "result.json"
    file.unlink(missing_ok=True)
    interpreter = dict(options.python).get(case.program, sys.executable)
    command = [interpreter, "-m", f"benchmarks.peers.{case.program}"]
    command += ["--table", case.table, "--variant", case.variant, "--size", options.size]
    command += ["--warmup", str(options.warmup), "--steps", str(options.steps)]
    command += [*(["--compile"] if options.compile else []), "--result", str(file)]
    command += ["--denoise-steps", *map(str, options.denoise_steps)]
    env = environment(case, options, str(folder / "cache"))
    names = {"table": case.table, "program": case.program, "variant": case.variant}
    try:
        process = subprocess.run(
            command, cwd=ROOT, env=env, capture_output=True, text=True, check=False
        )
    except OSError as error:
        return {**names, "error": f"{interpreter}: {error.strerror}"}
    if process.returncode or not file.exists():
        return {**names, "error": cause(process.stderr, process.returncode)}
    return {**names, **json.loads(file.read_text())}


def cause(stderr: str, code: int) -> str:
    """Return the line of a traceback that names the error, else the last line."""
    lines = [line for line in stderr.splitlines() if line.strip()]
    errors = [line for line in lines if line[:1].isalpha() and "Error" in line.partition(":")[0]]
    return (errors or lines or [f"exit status {code}"])[-1].strip()


def missing(result: dict[str, Any]) -> bool:
    """Whether a package or an interpreter of the program is not installed."""
    error = result.get("error", "")
    return "ModuleNotFoundError" in error or "No such file" in error


def measure(options: argparse.Namespace, console: Console) -> list[dict[str, Any]]:
    """Run all cases and write the results after each; skip programs found to be missing."""
    results, absent = [], set()
    with tempfile.TemporaryDirectory() as folder:
        for case in cases(options.tables, once=options.once):
            if case.program in absent:
                continue
            console.print(escape(f"{case.table}: {case.program}, {case.variant}"))
            results.append(result := run(case, options, Path(folder)))
            if "error" in result:
                console.print(escape(f"  {result['error']}"))
            if missing(result):
                absent.add(case.program)
                console.print(escape(f"  to install: {INSTALL[case.program]}"))
            write(options, results)
    return results


def write(options: argparse.Namespace, results: list[dict[str, Any]]) -> None:
    """Write settings, versions, tables and all results to `options.out`."""
    tables = {table: report.rows(results, table) for table in options.tables}
    settings = {name: getattr(options, name) for name in _SETTINGS}
    content = {**settings, "versions": report.versions(results), "tables": tables}
    options.out.write_text(json.dumps({**content, "results": results}, indent=1))


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="file for the results")
    parser.add_argument("--tables", nargs="+", choices=list(TABLES), default=list(TABLES))
    parser.add_argument("--size", choices=["base", "tiny"], default="base")
    for name, what in (("python", "interpreter"), ("path", "folders, separated by colons")):
        option = {"nargs": "+", "type": named, "default": [], "metavar": "PROGRAM=VALUE"}
        parser.add_argument(f"--{name}", help=f"{what} of a program", **option)
    parser.add_argument("--warmup", type=int, default=5, help="calls before the first timed one")
    parser.add_argument("--steps", type=int, default=30, help="timed calls")
    steps = "numbers of denoising steps to sample with"
    parser.add_argument("--denoise-steps", type=int, nargs="+", default=[10], help=steps)
    parser.add_argument("--once", action="store_true", help="do not repeat the references")
    parser.add_argument("--compile", action="store_true", help="torch.compile in LeRobot and PEFT")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark from the command line; return 1 if an installed program failed."""
    options, console = parser().parse_args(arguments), Console(soft_wrap=True)
    results = measure(options, console)
    for program, versions in report.versions(results).items():
        text = ", ".join(f"{package} {version}" for package, version in versions.items())
        console.print(escape(f"{program}: {text}"))
    for table in options.tables:
        if lines := report.rows(results, table):
            print_table(console, lines, table)
    return int(any("error" in result and not missing(result) for result in results))


if __name__ == "__main__":
    sys.exit(main())
