"""An action server in a process of its own that says the words of one goal, and the client that hears them."""

from __future__ import annotations

import subprocess
import sys

from s2a_bench.ros import Accepted, ActionClient, Feedback, Result
from tests.ros.action_suite import NAME, event, send, text_of

WORDS = [f"word{number}" for number in range(200)]
SERVER = """
import sys
from s2a_bench.ros import llama, open_middleware
name, domain_id, action, *places = sys.argv[1:]
middleware = open_middleware(name, domain_id=int(domain_id), place="".join(places), host=True)
server = middleware.action_server(action, llama.GENERATE_RESPONSE)
goal = server.next_goal(60)
goal.accept()
words = goal.unpack().prompt.split()
goal.executing()
for number, word in enumerate(words):
    goal.feedback(llama.token_feedback(word, number))
goal.succeed(llama.text_result(" ".join(words)))
sys.stdin.read()
middleware.close()
"""


def served(middleware: str, domain_id: int, *place: str) -> subprocess.Popen[bytes]:
    """Start the server, which ends with its standard input; at a ``place`` it is where nodes meet, too."""
    command = [sys.executable, "-c", SERVER, middleware, str(domain_id), NAME, *place]
    return subprocess.Popen(command, stdin=subprocess.PIPE)


def hears_them(client: ActionClient, seconds: float) -> None:
    """Ask the server once, and compare what it says."""
    assert client.wait_for_server(seconds)
    sent = send(client, " ".join(WORDS))
    assert event(client, Accepted).goal_id == sent
    assert [text_of(client, event(client, Feedback)) for _ in WORDS] == WORDS
    assert client.unpack_result(event(client, Result).packed).response.text == " ".join(WORDS)
