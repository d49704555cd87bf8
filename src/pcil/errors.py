"""The one error that is a person's to mend."""


class InputError(Exception):
    """Something that a person gave is wrong. The command line prints it as one sentence and exits with code 2."""
