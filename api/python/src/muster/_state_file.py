"""The framework's id on disk, so that a restarted framework comes back to its tasks."""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from pathlib import Path

from muster.errors import ConfigError
from muster.model import FrameworkInfo


class StateFile:
    def __init__(self, path: Path) -> None:
        self._path = path

    def read(self, info: FrameworkInfo) -> str:
        """The id that was written; empty: none. Another framework's file is refused: its tasks are not ours."""
        try:
            text = self._path.read_text(encoding="utf-8")
        except FileNotFoundError:
            return ""
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"the state file cannot be read: {error}") from error
        try:
            state = json.loads(text)
            written = (state["namespace"], state["name"])
            framework_id = state["frameworkId"]
        except (ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"{self._path} is not a framework's state file: {error!r}") from None
        if written != (info.namespace, info.name) or not isinstance(framework_id, str):
            whose = "/".join(map(str, written))
            raise ConfigError(f"{self._path} is the state of {whose}, not of {info.namespace}/{info.name}")
        return framework_id

    def write(self, info: FrameworkInfo, framework_id: str) -> None:
        """Whole or not at all, also when the machine stops meanwhile."""
        state = {"frameworkId": framework_id, "name": info.name, "namespace": info.namespace}
        descriptor, scratch = tempfile.mkstemp(prefix=f".{self._path.name}.", dir=self._path.parent)
        try:
            with os.fdopen(descriptor, "w", encoding="utf-8") as file:
                json.dump(state, file)
                file.write("\n")
                file.flush()
                os.fsync(file.fileno())
            os.replace(scratch, self._path)
        except BaseException:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(scratch)
            raise
        directory = os.open(self._path.parent, os.O_RDONLY)
        try:
            os.fsync(directory)
        finally:
            os.close(directory)

    def remove(self) -> None:
        self._path.unlink(missing_ok=True)
