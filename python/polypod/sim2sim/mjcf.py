"""Reader of MuJoCo files (MJCF, or a URDF): only MuJoCo itself understands them in full.

MuJoCo may end or hang on a file that was made to do so. `check` therefore lets another process
compile the file first, within limits of time and memory; that process runs this file alone, so it
imports nothing of polypod.
"""

import dataclasses
import importlib
import json
import os
import re
import stat
import sys
from pathlib import Path
from typing import Any

MAX_BYTES = 64 << 20
"""Largest size of a file, bytes."""
HEAD = 1 << 16
"""Bytes in which the root element of a file stands."""
MAX_SECONDS = 60
"""Computing time that MuJoCo may take to compile the file."""
MAX_MEMORY = 8 << 30
"""Bytes of address space that it may take for it."""


@dataclasses.dataclass
class Reading:
    """A file as MuJoCo read it, not compiled yet."""

    spec: Any
    """`mujoco.MjSpec`."""
    left_out: list[str]
    """Parts that are left out since their files are missing, one line each."""


def read(path: str) -> Reading:
    """Reads a file, without the meshes and textures whose files are missing.

    Raises:
        ValueError: for a file that MuJoCo does not read, and for a missing mesh that a link's mass
            comes from.
    """
    mj = importlib.import_module("mujoco")
    spec = mj.MjSpec.from_file(path)
    if _is_urdf(path):
        # MuJoCo would merge a root link, which hangs on no joint, into the world
        spec.compiler.fusestatic = False
    left_out: list[str] = []
    _leave_out_meshes(mj, spec, left_out)
    _leave_out_textures(spec, left_out)
    return Reading(spec, left_out)


def _is_urdf(path: str) -> bool:
    """Whether the root element of a file is <robot>."""
    with Path(path).open("rb") as file:
        head = file.read(HEAD).decode("utf-8", errors="replace")
    head = re.sub(r"<!--.*?-->|<\?.*?\?>|<!DOCTYPE[^>]*>", "", head, flags=re.DOTALL)
    return re.match(r"[\s\ufeff]*<\s*robot\b", head) is not None


def check(path: Path) -> None:
    """Lets MuJoCo compile the file in another process.

    Raises:
        ValueError: with one line that says what is wrong.
    """
    try:
        state = path.stat()
    except OSError as error:
        raise ValueError(error.strerror or str(error)) from error
    except ValueError as error:
        raise ValueError(f"its name is no name of a file ({error})") from error
    if not stat.S_ISREG(state.st_mode):
        raise ValueError("it is not a regular file")
    if state.st_size > MAX_BYTES:
        raise ValueError(f"it has more than {MAX_BYTES >> 20} MiB")
    # the process runs this file, which imports nothing of polypod by itself
    from polypod.add import child

    request = {"path": os.fspath(path.resolve()), "seconds": MAX_SECONDS}
    try:
        problem = child.ask(__file__, request, MAX_SECONDS)
    except child.UnansweredError as error:
        raise ValueError(f"MuJoCo {error}") from None
    if problem is not None:
        raise ValueError(str(problem))


def one_line(error: BaseException) -> str:
    """An error of MuJoCo in one line."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 300 else text[:297] + "..."


def _leave_out_meshes(mj: Any, spec: Any, left_out: list[str]) -> None:
    missing = {mesh.name: mesh for mesh in spec.meshes if mesh.file and not _is_there(spec, spec.meshdir, mesh.file)}
    if not missing:
        return
    seen = touching = 0
    bodies = []
    for geom in list(spec.geoms):
        if geom.meshname not in missing:
            continue
        body = geom.parent
        always = spec.compiler.inertiafromgeom == mj.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
        has_mass = geom.mass != 0.0 and geom.density != 0.0
        if has_mass and body.name != "world" and (always or not body.explicitinertial):
            raise ValueError(
                f"body '{body.name}' takes its mass from mesh '{geom.meshname}', and {missing[geom.meshname].file} is "
                "missing; put the meshes where the file says, or give the body an <inertial>"
            )
        if geom.contype or geom.conaffinity:
            touching += 1
            bodies.append(body.name)
        else:
            seen += 1
        spec.delete(geom)
    for mesh in missing.values():
        spec.delete(mesh)
    left_out.append(f"files of {len(missing)} meshes are missing: {seen} shapes that are only seen are left out")
    if touching:
        names = ", ".join(dict.fromkeys(bodies))
        left_out.append(f"{touching} shapes that touch are left out, their meshes are missing: {names}")


def _leave_out_textures(spec: Any, left_out: list[str]) -> None:
    missing = {
        texture.name: texture
        for texture in spec.textures
        if texture.file and not _is_there(spec, spec.texturedir or spec.meshdir, texture.file)
    }
    for material in spec.materials if missing else ():
        material.textures = ["" if name in missing else name for name in material.textures]
    for texture in missing.values():
        spec.delete(texture)
    if missing:
        left_out.append(f"files of {len(missing)} textures are missing: left out")


def _is_there(spec: Any, folder: str, file: str) -> bool:
    name = Path(file).name if spec.strippath else file
    return (Path(spec.modelfiledir) / folder / name).is_file()


def _main() -> None:
    """Prints what is wrong with the file of the request as JSON; null if nothing is."""
    request = json.loads(sys.stdin.read())
    try:
        import resource
    except ImportError:  # on systems without it
        pass
    else:
        _, hard = resource.getrlimit(resource.RLIMIT_AS)
        most = MAX_MEMORY if hard == resource.RLIM_INFINITY else min(MAX_MEMORY, hard)
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        _, hard = resource.getrlimit(resource.RLIMIT_CPU)
        seconds = request["seconds"] if hard == resource.RLIM_INFINITY else min(request["seconds"], hard)
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, hard))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    problem = None
    try:
        mj = importlib.import_module("mujoco")
        model = read(request["path"]).spec.compile()
        data = mj.MjData(model)
        mj.mj_forward(model, data)
    except Exception as error:
        problem = one_line(error)
    print(json.dumps(problem), flush=True)


if __name__ == "__main__":
    _main()
