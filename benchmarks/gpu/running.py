"""Run a stage in a process of its own, for a limited time, and keep its results until then.

A kernel that writes out of bounds spoils a process's GPU context for good, so no two stages share one. A stage appends
each result to a file of JSON lines as soon as it has it; whatever ends the stage, these lines are read. As a command,
`python -m benchmarks.gpu.running STAGE OPTIONS RECORDS`, it is that process.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import traceback
from dataclasses import asdict
from pathlib import Path
from typing import Any, Callable, Dict

from benchmarks.gpu.options import ROOT, Options, Skipped, first_line
from benchmarks.gpu.stages import STAGES

__all__ = ["environment", "run_stage"]

GRACE = 5.0  # seconds between asking a process to end and ending it
GLANCE = 0.5  # seconds between two looks at a stage's results


def run_stage(name: str, options: Options, seconds: float, keep: Callable[[Dict[str, Any]], None]) -> Dict[str, Any]:
    """Run a stage and return its results, with "status", "reason" where it is not "done", and "seconds".

    Args:
        name: the stage's.
        options: for the stage.
        seconds: after these it is stopped, with all of its children.
        keep: called with the results so far whenever there are more.

    Raises:
        KeyboardInterrupt: as it came; what was found is kept, with the status "interrupted".
    """
    lines = Path(options.work) / f"{name}.jsonl"
    lines.write_text("", encoding="utf-8")
    command = [sys.executable, "-m", "benchmarks.gpu.running", name, json.dumps(asdict(options)), str(lines)]
    began, seen = time.monotonic(), 0
    # A session of its own, so that it is ended with everything that it has started.
    process = subprocess.Popen(command, cwd=str(ROOT), env=environment(options), start_new_session=True)
    found: Dict[str, Any] = {}
    try:
        while process.poll() is None and time.monotonic() - began < seconds:
            time.sleep(GLANCE)
            if lines.stat().st_size != seen:
                seen = lines.stat().st_size
                keep({**_read(lines), "status": "running"})
        timed_out = process.poll() is None
        _end(process)
        found = _read(lines)
        if timed_out:
            found.update(status="timed out", reason=f"stopped after {seconds:.0f} s")
        elif "status" not in found:
            found.update(status="failed", reason=f"its process ended with exit code {process.returncode}")
    except KeyboardInterrupt:
        _end(process)
        found = {**_read(lines), "status": "interrupted"}
        raise
    finally:
        if found:
            found["seconds"] = round(time.monotonic() - began, 1)
            keep(found)
    return found


def environment(options: Options) -> Dict[str, str]:
    """Return the environment of a stage: this checkout's packages, and the modules that were built."""
    built = [] if options.emulate else [str(options.site)]
    search = [str(ROOT), str(ROOT / "adapters"), *built, os.environ.get("PYTHONPATH", "")]
    return {
        **{key: value for key, value in os.environ.items() if not key.startswith("LEGS_")},
        "PYTHONPATH": os.pathsep.join(path for path in search if path),
        "PYTHONUNBUFFERED": "1",
    }


def _read(lines: Path) -> Dict[str, Any]:
    found: Dict[str, Any] = {}
    for line in lines.read_text(encoding="utf-8").splitlines():
        try:
            found.update(json.loads(line))
        except ValueError:  # it was ended while it wrote
            continue
    return found


def _end(process: subprocess.Popen[bytes]) -> None:
    """End the processes of a session that still run."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        try:
            os.killpg(process.pid, number)
        except ProcessLookupError:
            break
        try:
            process.wait(GRACE)
        except subprocess.TimeoutExpired:
            continue
    process.wait()


def main(stage: str, options: str, records: str) -> int:
    """Run a stage in this process; append its results, and how it ended, to a file of JSON lines."""
    with open(records, "a", encoding="utf-8") as file:

        def record(**found: Any) -> None:
            file.write(json.dumps(found) + "\n")
            file.flush()

        try:
            STAGES[stage].load()(Options(**json.loads(options)), record)
            record(status="done")
        except Skipped as reason:
            record(status="skipped", reason=str(reason))
        except Exception as error:  # the other stages are worth having
            traceback.print_exc()
            record(status="failed", reason=first_line(error))
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
