"""Text of files and users, as it is printed."""


def plain(text: str) -> str:
    """The text in one line, without characters that a terminal obeys in place of showing."""
    return "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in " ".join(text.split()))
