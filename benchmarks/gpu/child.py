"""One stage: `python -m benchmarks.gpu.child STAGE OPTIONS RECORDS`, started by running.py."""

from __future__ import annotations

import json
import sys
import traceback
from typing import Any

from benchmarks.gpu.options import Options, Skipped, first_line
from benchmarks.gpu.stages import STAGES


def main(stage: str, options: str, records: str) -> int:
    """Run a stage; append its results, and how it ended, to a file of JSON lines."""
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
