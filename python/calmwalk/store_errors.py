"""What can be wrong with the store of a campaign."""


class StoreError(Exception):
    """A campaign cannot be read; the message says what was found and what was expected."""


class MissingCampaign(StoreError):
    """There is no campaign in this place."""


class SchemaError(StoreError):
    """The tables are those of another program, or of a version that this package does not read."""


class DamagedError(StoreError):
    """Stored bytes differ from what was written."""


class MissingPackage(StoreError, ImportError):
    """An optional Python package is needed for this."""
