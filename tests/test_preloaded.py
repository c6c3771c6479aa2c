"""A process that begins with torch imported ends as one that a shell starts."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.preloaded import run
from tests.support import legs_environment

ENDINGS = {
    "the last line": "print('done', end='')",
    "a code": "import sys; print('half', end=''); sys.exit(3)",
    "a large code": "import sys; sys.exit(-1)",
    "no code": "import sys; sys.exit()",
    "a message": "import sys; sys.exit('what is wrong')",
    "a truth": "import sys; sys.exit(True)",
    "an error": "raise ValueError('wrong')",
    "ctrl-c": "import os, signal, time; os.kill(os.getpid(), signal.SIGINT); time.sleep(9)",
    "killed": "import os, signal; os.kill(os.getpid(), signal.SIGKILL)",
    "what is left to do": "import atexit, sys; atexit.register(lambda: print('left')); sys.exit(2)",
    "a thread": "import threading, time; threading.Thread(target=lambda: (time.sleep(0.1), print('late'))).start()",
    "a closed stream": "import sys; sys.stderr.close(); sys.exit(2)",
}


@pytest.mark.parametrize("ending", ENDINGS)
def test_it_ends_as_any_other(ending):
    command = [sys.executable, "-c", ENDINGS[ending]]
    found = run(command, env=legs_environment())
    expected = subprocess.run(command, env=legs_environment(), capture_output=True, text=True)
    assert (found.returncode, found.stdout) == (expected.returncode, expected.stdout)
    assert found.stderr.splitlines()[-1:] == expected.stderr.splitlines()[-1:]  # above it, the frames that differ
