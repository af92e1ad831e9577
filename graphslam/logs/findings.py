"""What is found out about a log besides its messages: one record per finding, and lines for people.

A finding says what it is and, where something can be done about it, which setting or recording
mends it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

#: how much it matters: nothing to mind; the result may be worse for it; there is none
Severity = Literal["note", "doubt", "unusable"]


@dataclass(frozen=True, slots=True)
class Finding:
    """``text`` says what was found about ``topic`` (or a robot, a file), ``remedy`` what mends it.

    ``check`` names what was looked at. ``topic`` is empty, or ``remedy`` where nothing is to do.
    """

    severity: Severity
    check: str
    topic: str
    text: str
    remedy: str = ""

    @property
    def line(self) -> str:
        """All of it in one line, as warnings have it."""
        where = f"{self.topic}: " if self.topic else ""
        return where + self.text + (f"; {self.remedy}" if self.remedy else "")


def topics_setting(robots: Mapping[str, str]) -> str:
    """The option that makes these topics, with the robots that they belong to, the ones read."""
    pairs = ", ".join(f'"{topic}" = "{robot}"' for topic, robot in robots.items())
    return f"--set 'logs.topics={{{pairs}}}'"
