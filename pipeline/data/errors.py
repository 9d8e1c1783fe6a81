"""Errors that data can cause, by what the user must do about them."""


class CityError(Exception):
    """Base of every error that input data or a run can cause.

    The message alone is in ``args``, so an error survives pickling, process pools and Dask. It names
    the place, the observed value against its bound, and the next move.
    """

    exit_code = 1

    @property
    def lines(self) -> list[str]:
        """The message as it is shown: one line."""
        return [str(self)]


class InputError(CityError):
    """A file or a value in it cannot be used: mend or leave out the input."""


class OutputError(CityError):
    """A result cannot be written: free space, or choose another folder."""


class ConfigError(CityError):
    """The command line or the configuration asks for something impossible: change it."""

    exit_code = 2


class GeometryError(CityError):
    """A geometric step found no valid result for this input: look at the place that it names."""


class SolverError(CityError):
    """A linear solve did not reach its tolerance: change the parameters that the message names."""
