"""The one exception whose message is meant for the person at the keyboard."""


class UserError(ValueError):
    """A mistake the user can mend.

    The message is one sentence that says what is wrong, where, and how to mend it. The command line
    prints it and ends with exit code 2; everything else that is raised is a defect of this library.
    """
