"""The one exception whose message is meant for the person at the keyboard."""

from nets.text import printable


class UserError(ValueError):
    """A mistake the user can mend.

    The message is one sentence that says what is wrong, where, and how to mend it. The command line
    prints it and ends with exit code 2; everything else that is raised is a defect of this library.
    Names of files may hold anything, so what is not printable is escaped.
    """

    def __init__(self, sentence: str) -> None:
        """Take the sentence."""
        super().__init__(printable(sentence))


class StoppedError(UserError):
    """Ctrl-C ended the work early; the sentence says what there is of it."""

    code = 130
