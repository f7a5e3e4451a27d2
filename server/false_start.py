"""Whether the newest frame a map knows had an id that the stream has not got to, as later frames show."""

#: Frames in a row that show it.
_BELIEVED = 3
#: A lossless agent sends again what a server that ended before it could confirm it has tracked already; it
#: has no more frames under way.
_SENT_AGAIN = 64


class FalseStart:
    """Judges by the frames below the newest one's id: an agent's ids rise with the numbers of its frames.

    The first frame of a stream has nothing to be judged by when it comes. With an id from far ahead it would
    make all others count as tracked already.
    """

    def __init__(self) -> None:
        self._num_in_order = 0
        self._last_id = -1

    def note_followed(self) -> None:
        """Note a frame whose id is above the newest one's."""
        self._num_in_order = 0

    def is_shown_by(self, frame_id: int, seq: int, newest_seq: int | None) -> bool:
        """Tell whether the newest frame was wrong, after one with an id that is not above its own.

        Args:
            frame_id: Of this frame.
            seq: Its number among those that were sent.
            newest_seq: The same of the newest frame, None where it is not known.
        """
        if newest_seq is not None and 0 <= newest_seq - seq <= _SENT_AGAIN:
            return False
        self._num_in_order = self._num_in_order + 1 if frame_id > self._last_id else 1
        self._last_id = frame_id
        return self._num_in_order >= _BELIEVED
