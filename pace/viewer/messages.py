"""What a browser may change: the value of a control. Needs the extra ``viewer``.

viser follows every message that it knows. It would set any attribute of a control, keep uploads in memory, or show the
page to the internet through the server of its makers, whether the page has a button for that or not.
"""

from __future__ import annotations

import logging
import math
from typing import Any

from pace.config.base import printable

LONGEST = 200  # letters of a text that a browser sets, or that is shown of it


def listen_to_controls(server: Any) -> None:
    """From now on ``server`` (viser) takes only values of its controls from browsers, and where their cameras are."""
    logging.getLogger("websockets.server").addFilter(_in_one_line)
    websocket = server._websock_server
    follow = websocket._handle_incoming_message

    async def follow_values(client: int, message: Any) -> None:
        if is_value(server.gui, message):
            await follow(client, message)

    def connected(connection: Any) -> None:
        follow_own = connection._handle_incoming_message

        async def follow_camera(client: int, message: Any) -> None:
            if type(message).__name__ == "ViewerCameraMessage":
                await follow_own(client, message)

        connection._handle_incoming_message = follow_camera

    websocket._handle_incoming_message = follow_values
    websocket.on_client_connect(connected)


def _in_one_line(record: logging.LogRecord) -> bool:
    """Of a browser whose message cannot be read, and which is sent away, no traceback is shown."""
    if record.exc_info and record.exc_info[1] is not None:
        error = record.exc_info[1]
        reason = printable(str(error) or type(error).__name__)[:LONGEST]
        record.msg, record.args = f"a browser is sent away, it does not speak the page's language: {reason}", ()
        record.exc_info = None
    return True


def is_value(gui: Any, message: Any) -> bool:
    """Whether a message sets a control to a value of the kind that it has."""
    if type(message).__name__ != "GuiUpdateMessage" or not isinstance(message.uuid, str):
        return False
    if not isinstance(message.updates, dict) or list(message.updates) != ["value"]:
        return False
    control, value = gui._gui_input_handle_from_uuid.get(message.uuid), message.updates["value"]
    return control is not None and _fits(control, value)


def _fits(control: Any, value: Any) -> bool:
    current = control.value
    if isinstance(current, bool) or isinstance(value, bool):
        return isinstance(current, bool) and isinstance(value, bool)
    if isinstance(current, int | float):
        return isinstance(value, int | float) and math.isfinite(value)
    if not isinstance(value, str) or len(value) > LONGEST:
        return False
    return value in getattr(control, "options", (value,))
