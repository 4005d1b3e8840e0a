"""How large a picture is by its header, before anything decodes it: a small file may state billions of pixels."""

_JPEG_FRAMES = tuple(bytes([0xFF, 0xC0 + kind]) for kind in (0, 1, 2, 3, 5, 6, 7, 9, 10, 11, 13, 14, 15))


def picture_size(content: bytes) -> tuple[int, int] | None:
    """Width and height that the header of a PNG or JPEG states; None of other content."""
    if content[:8] == b"\x89PNG\r\n\x1a\n":
        return int.from_bytes(content[16:20]), int.from_bytes(content[20:24])
    at = 2
    while content[:2] == b"\xff\xd8" and len(content) >= at + 9:
        marker, length = content[at : at + 2], int.from_bytes(content[at + 2 : at + 4])
        if marker in _JPEG_FRAMES:
            return int.from_bytes(content[at + 7 : at + 9]), int.from_bytes(content[at + 5 : at + 7])
        at += 2 + length
    return None
