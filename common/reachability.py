"""Whether something is there where a client does not get through, asked by plain TCP connections."""

import re
import socket
from collections.abc import Iterable

_OVER_TCP = re.compile(r"(?:tcp|tls|ws)/\[?(?P<host>\S+?)\]?:(?P<port>\d+)(?:[?#]\S*)?")
_TIMEOUT_S = 1.0


class Knocks:
    """Asks at the endpoints of a hub.

    Those of other protocols, and names that nobody knows, can't be asked.
    """

    def __init__(self, endpoints: Iterable[str]) -> None:
        places = {endpoint: _OVER_TCP.fullmatch(endpoint) for endpoint in endpoints}
        self._places = {e: (found["host"], int(found["port"])) for e, found in places.items() if found}
        self._num_endpoints = len(places)
        self._unknown_hosts: list[str] = []

    @property
    def all_can_be_asked(self) -> bool:
        """Whether nothing is there where nothing answers."""
        return len(self._places) == self._num_endpoints

    @property
    def unknown_hosts(self) -> tuple[str, ...]:
        """Names for which no address was found when they were asked."""
        return tuple(self._unknown_hosts)

    def answering(self) -> str | None:
        """Return the first endpoint where something takes a connection now."""
        for endpoint, place in list(self._places.items()):
            try:
                with socket.create_connection(place, _TIMEOUT_S):
                    return endpoint
            except (socket.gaierror, UnicodeError):
                del self._places[endpoint]  # asking for a name again can take long each time
                self._unknown_hosts.append(place[0])
            except OSError:
                pass
        return None
