"""Errors of adapters."""


class AdapterError(Exception):
    """An adapter cannot do what it was asked for."""


class InputError(AdapterError):
    """A model file, an option or a message is not what the adapter needs. Says what was found and what was expected."""
