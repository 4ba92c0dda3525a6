# SPDX-License-Identifier: Apache-2.0
"""Vision-language models behind one interface: requests, replies, and the clients that connect to models.

client = wiw.vlm.connect("http://localhost:8000/v1", model="Qwen/Qwen2.5-VL-72B-Instruct-AWQ")
(reply,) = client.ask([Request((user("What is in the red box?", image),), choices=("chair", "table"))])
"""

from wiw.vlm.base import Client
from wiw.vlm.connection import connect
from wiw.vlm.messages import Message, Problem, Reply, Request, user

__all__ = ["Client", "Message", "Problem", "Reply", "Request", "connect", "user"]
