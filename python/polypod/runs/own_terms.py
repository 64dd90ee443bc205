"""Terms in Python of a run that is used again: the file is named by the user, never by the run."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from polypod import _core
from polypod.motions import tracking
from polypod.python_terms import Terms, load


def terms_of_run(manifest: Mapping[str, Any], file: Path | None, name: str) -> Terms | None:
    """The terms of a run for an evaluation or a film.

    Args:
        manifest: of the run.
        file: what `--terms` names; None: nothing.
        name: of the policy, for errors.

    Raises:
        ConfigError: for a run that was begun without terms or with another file, and for a policy
            that observes terms whose file is not named.
    """
    began = manifest.get("terms")
    if file is None and (own := manifest.get("motions")) is not None:
        return tracking.of_manifest(own, name)
    if file is None:
        if columns := observed(manifest):
            known = began["file"] if began is not None else "the file of terms"
            raise _core.ConfigError(
                f"{name} observes {', '.join(columns)}, which {known} computes; name that file with --terms"
            )
        return None
    terms = load(file)
    if began is None and not observed(manifest):
        raise _core.ConfigError(f"--terms {file}: {name} was trained without terms in Python; leave --terms out")
    if began is not None and terms.sha256 != began["sha256"]:
        raise _core.ConfigError(
            f"--terms {file} is not the file that {name} was trained with, {began['file']}; take that one: a copy lies "
            "in the run's params/terms.py"
        )
    return terms


def observed(manifest: Mapping[str, Any]) -> list[str]:
    """Names of the terms in Python that are observed, by the run's changes of the task."""
    names = []
    for change in manifest["overrides"]:
        key, _, value = change.partition("=")
        if key.startswith("observations.") and key.endswith(".+") and "external = {" in value:
            start = value.index('term = "') + len("term = ")
            names.append(str(json.JSONDecoder().raw_decode(value[start:])[0]))
    return names
