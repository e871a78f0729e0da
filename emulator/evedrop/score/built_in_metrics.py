"""The built-in metrics of a receiver as attributes, for editors and type checkers."""

from __future__ import annotations

from abc import ABC, abstractmethod


class BuiltInMetrics(ABC):
    """The built-in metrics, each None if it has no value; those of installed packages only have names."""

    @abstractmethod
    def metric(self, name: str) -> float | None:
        """A metric by its name; None if it has no value, or if there is no such metric."""

    @property
    def mean_squared_error(self) -> float | None:
        """Mean of |x − x̂|² over slots and trials; None in a covariance-only study."""
        return self.metric("mean_squared_error")

    @property
    def mean_trace_covariance(self) -> float | None:
        """Mean of tr P, the error covariance that the receiver believes."""
        return self.metric("mean_trace_covariance")

    @property
    def expected_trace_covariance(self) -> float | None:
        """Theory: the trace of the expected actual error covariance over the same slots; None if no theory covers it."""
        return self.metric("expected_trace_covariance")

    @property
    def received_fraction(self) -> float | None:
        """The fraction of packets received."""
        return self.metric("received_fraction")

    @property
    def used_fraction(self) -> float | None:
        """The fraction of packets received and used."""
        return self.metric("used_fraction")

    @property
    def mean_actual_trace_covariance(self) -> float | None:
        """In a covariance-only study, the mean trace of the actual error covariance given the events; otherwise None."""
        return self.metric("mean_actual_trace_covariance")
