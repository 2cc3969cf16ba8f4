"""What a worker of ``WorkerVecEnv`` does. As in ``group``, neither SB3 nor PyTorch is imported."""

import signal
import traceback
from multiprocessing.connection import Connection
from typing import Any

import cloudpickle

from sb3_ddiffpg.envs.vec_env.group import NOBODY, EnvGroup, answer_of


class Pickled:
    """
    As ``CloudpickleWrapper`` of SB3: something that goes to another process by cloudpickle.

    :param value: what goes there
    """

    def __init__(self, value: Any) -> None:
        self.value = value

    def __getstate__(self) -> bytes:
        return cloudpickle.dumps(self.value)

    def __setstate__(self, state: bytes) -> None:
        self.value = cloudpickle.loads(state)


def work(remote: Connection, parent: Connection, env_fns: Pickled, turn: Any) -> None:
    """
    What a worker does: it answers each command with ``("ok", result)`` or ``("error", (environment, lacks, text))``, where
    ``lacks`` says whether it was an AttributeError; a class of one's own may be known here alone.

    :param remote: where commands come from
    :param parent: the other end
    :param env_fns: functions that make the environments
    :param turn: its ``value`` says whose turn it is
    """
    parent.close()
    for number in (signal.SIGINT, signal.SIGTERM):  # they may reach all processes; the parent says what happens now
        signal.signal(number, signal.SIG_IGN)
    envs: EnvGroup | None = None
    while True:
        try:
            command, argument = remote.recv()
        except EOFError:
            break  # the parent is gone
        answered = False
        try:
            if command == "make":
                envs = EnvGroup(env_fns.value, turn)
                result: Any = (envs.observation_space, envs.action_space, envs.render_mode)
            elif command == "close":
                break
            else:
                result = answer_of(envs, command, argument)
            answered = True
            remote.send(("ok", result))
        except Exception as error:  # of an environment, or of an answer that cannot be sent
            lacks = isinstance(error, AttributeError) and not answered
            remote.send(("error", (NOBODY if answered else turn.value, lacks, traceback.format_exc())))
    if envs is not None:
        envs.close()
    remote.close()
