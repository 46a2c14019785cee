"""A log that grows: its lines as they are written, over rotations of the file."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from obsynth.errors import SpecError
from obsynth.files.inputs import path_of, reason
from obsynth.monitoring.logs.text_logs import REMARK, WINDOWS_TEXT

#: Seconds between looks at a file that has not grown: a line waits for half of that on average.
POLL_SECONDS = 0.2

#: Stands between the lines of one file and those of the next.
NEW_FILE = None


class FollowedLog:
    """A text stream of the lines of a file to which rows are appended; `readline` waits for the next whole line.

    Where the file is replaced by another one (renamed by logrotate, and created again), or is cut (its option
    ``copytruncate``), what is left of the old one comes first, and then the new one from its start: its header is
    passed over where it is that of the first file.

    Parameters
    ----------
    path : str or Path
        A text log.
    wait : callable, optional
        Called with `POLL_SECONDS` where there is no line yet; a true value ends the stream.
    """

    def __init__(self, path: str | Path, *, wait: Callable[[float], object] = time.sleep) -> None:
        self._path, self._wait = path_of(path), wait
        self.name = str(self._path)
        self._file, self._part, self._lines = self._opened(), b"", deque[bytes | None]()
        # The first line that is no remark, and whether that of this file is still to come.
        self._header, self._is_at_head = "", True

    def readline(self) -> str:
        """Return the next line, when it is whole; an empty text where the stream has ended."""
        while True:
            self._read()
            if self._lines:
                line = self._lines.popleft()
                if line is NEW_FILE:
                    self._is_at_head = True
                    continue
                text = line.decode("utf-8", errors=WINDOWS_TEXT)
                if not self._is_repeated(text):
                    return text
            elif self._file.closed or (not self._turned() and self._wait(POLL_SECONDS)):
                self.close()
                return ""

    def __iter__(self) -> Iterator[str]:
        """Yield the lines as they come."""
        return iter(self.readline, "")

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _opened(self) -> BinaryIO:
        try:
            return self._path.open("rb")
        except OSError as error:
            raise SpecError(
                f"{self.name} cannot be followed: {reason(error)}. Start when the log is there.", path="--follow"
            ) from error

    def _read(self) -> None:
        """Take the lines that are whole by now."""
        if not self._lines and not self._file.closed:
            *lines, self._part = (self._part + self._file.read()).splitlines(keepends=True) or [b""]
            if self._part.endswith(b"\n"):
                lines, self._part = [*lines, self._part], b""
            self._lines.extend(lines)

    def _turned(self) -> bool:
        """Go on with the file that has taken this one's place, if there is one."""
        try:
            file_by_name = os.stat(self._path)
        except OSError:
            return False  # between the old file and the new one
        open_file = os.fstat(self._file.fileno())
        is_same = (file_by_name.st_dev, file_by_name.st_ino) == (open_file.st_dev, open_file.st_ino)
        if is_same and file_by_name.st_size >= self._file.tell():
            return False
        unread = self._part if is_same else self._part + self._file.read()
        self._file.close()
        # A last line that was never ended is a line.
        self._lines.extend(line if line.endswith(b"\n") else line + b"\n" for line in unread.splitlines(keepends=True))
        self._lines.append(NEW_FILE)
        self._file, self._part = self._opened(), b""
        return True

    def _is_repeated(self, text: str) -> bool:
        """Whether a line is the header of a later file."""
        if not self._is_at_head or not text.strip() or text.startswith(REMARK):
            return False
        self._is_at_head = False
        if not self._header:
            self._header = text.strip()
            return False
        return text.strip() == self._header
