"""Compiles one MJCF file of a stranger, in a process that does nothing else.

MuJoCo may end, hang or take all memory at a file that was made to do so. This process does first
what `polypod.add.compiling` does: it reads a request from its standard input and writes what is
wrong with the file to its standard output, as JSON; null if nothing is.
"""

import json
import sys
from pathlib import Path


def main() -> None:
    """Compiles the file of the request."""
    request = json.loads(sys.stdin.read())
    sys.path[:] = request["path"]
    from polypod import _core
    from polypod.add import child, compiling

    compiling.mujoco()
    child.bound(as_=child.MEMORY, core=0, cpu=request["seconds"])
    problem = None
    try:
        compiling.compiled(Path(request["file"]), request["root"])
    except _core.PolypodError as error:
        problem = str(error.args[0] if error.args else error)
    except MemoryError:
        problem = f"{request['file']}: MuJoCo needs more than {child.MEMORY >> 30} GiB for it; correct the file"
    print(json.dumps(problem), flush=True)


if __name__ == "__main__":
    main()
