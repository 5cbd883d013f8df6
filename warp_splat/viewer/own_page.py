"""Only the viewer's own page may speak with its server.

A browser lets any page open a WebSocket to any machine, and says in ``Origin`` whose page it is. A name that was made
to point at this machine after its page was loaded (DNS rebinding) gives itself away in ``Host``.
"""

import ipaddress
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from urllib.parse import urlsplit

from websockets.asyncio import server


def is_own(host: str | None, origin: str | None, upgrade: bool) -> bool:
    """Whether a request is that of somebody who typed this machine's address, or of the page that this brought.

    Args:
        host: the header; its name may be an IP address, localhost or the name of this machine, its port any.
        origin: the header, which browsers send with ``upgrade``; it must then name the same host.
        upgrade: the request is for a WebSocket.
    """
    try:
        if (name := urlsplit(f"//{host}").hostname or "") not in ("localhost", socket.gethostname().lower()):
            ipaddress.ip_address(name)
    except ValueError:
        return False
    return not upgrade or origin in (f"http://{host}", f"https://{host}")


@contextmanager
def only_own_page() -> Iterator[None]:
    """Have a server of viser's that is made in the meantime answer 403 to others; viser has no setting for it."""
    serve = server.serve

    def guarded(*arguments, process_request, **options):
        def answer(connection, request):
            headers = request.headers
            if is_own(headers.get("Host"), headers.get("Origin"), "Upgrade" in headers):
                return process_request(connection, request)
            return connection.respond(HTTPStatus.FORBIDDEN, "Only the viewer's own page may connect.\n")

        return serve(*arguments, process_request=answer, **options)

    server.serve = guarded  # type: ignore
    try:
        yield
    finally:
        server.serve = serve  # type: ignore
