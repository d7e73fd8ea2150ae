"""Test that the log of a node does not repeat a warning without limit."""

from __future__ import annotations

from typing import Any

import pytest
import structlog

from flexsheet.nodes.log_limit import MAX_DISTINCT, REPORT_PERIOD_S, RepeatLimiter


class Log:
    """A logger with a limiter, and a clock that the test sets."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.passed: list[dict[str, Any]] = []
        self.logger = structlog.wrap_logger(
            None,
            processors=[RepeatLimiter(lambda: self.now_s), self._keep],
            wrapper_class=structlog.BoundLogger,
        )

    def _keep(self, _: Any, __: str, record: Any) -> Any:
        self.passed.append(dict(record))
        raise structlog.DropEvent


@pytest.fixture
def log() -> Log:
    return Log()


def test_of_414_warnings_the_first_and_two_counts_are_logged(log: Log) -> None:
    for number in range(414):
        problem = f"no answer from 127.0.0.1:5020 within {30 + number % 3} ms"
        log.logger.warning("arm lost", problem=problem)
    assert [one.get("count") for one in log.passed] == [None, 10, 100]
    assert log.passed[0]["problem"] == "no answer from 127.0.0.1:5020 within 30 ms"


def test_a_repeated_warning_is_logged_once_a_period(log: Log) -> None:
    for second in range(int(3 * REPORT_PERIOD_S) + 1):
        log.now_s = float(second)
        log.logger.warning("input", problem="damaged")
    logged = [one.get("count") for one in log.passed]
    assert logged == [None, 10, 70, 100, 160]


def test_another_text_is_another_warning(log: Log) -> None:
    for problem in ("no connection", "no answer", "no connection", "no answer"):
        log.logger.warning("arm lost", problem=problem)
    log.logger.error("arm lost", problem="no connection", topic="arm_left")
    assert [(one["problem"], one.get("topic")) for one in log.passed] == [
        ("no connection", None),
        ("no answer", None),
        ("no connection", "arm_left"),
    ]


def test_news_is_never_held_back(log: Log) -> None:
    for _ in range(5):
        log.logger.info("recording", bag="a.mcap")
    assert len(log.passed) == 5


def test_counts_of_the_oldest_are_forgotten_first(log: Log) -> None:
    names = [f"{'a' * (number + 1)}" for number in range(MAX_DISTINCT + 1)]
    for name in names:
        log.logger.warning("input", problem=name)
    log.passed.clear()
    log.logger.warning("input", problem=names[-1])
    log.logger.warning("input", problem=names[0])
    assert [one["problem"] for one in log.passed] == [names[0]]
