"""`remote_object`: calls of a blocking object from the event loop."""

from __future__ import annotations

import asyncio
import gc
import re
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from actors.interfaces import LaboratoryError
from actors.runtime import remote_object as device
from actors.runtime.remote_object import DeviceLostError, LocalDevice, RayDevice


class Stuck:
    """Moves until somebody lets it go, and then says that it was stopped."""

    def __init__(self) -> None:
        self.moving, self.released = threading.Event(), threading.Event()

    def move(self) -> None:
        self.moving.set()
        self.released.wait(10.0)
        raise RuntimeError("stopped on the way")


@pytest.mark.parametrize("how", ["cancelled", "given up at its deadline"])
def test_what_a_call_says_after_nobody_waits_for_it_any_more_is_no_stray_message(how: str) -> None:
    stray: list[dict[str, Any]] = []
    stuck = Stuck()

    async def play() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda loop, context: stray.append(context))
        device = LocalDevice("arm", lambda: stuck)
        calling = asyncio.create_task(device.call("move", deadline=30.0 if how == "cancelled" else 0.2))
        await asyncio.to_thread(stuck.moving.wait, 5.0)
        if how == "cancelled":
            calling.cancel()
        await asyncio.wait({calling})
        stuck.released.set()
        await asyncio.sleep(0.1)  # the abandoned call ends meanwhile, which must change nothing
        assert calling.cancelled() or isinstance(calling.exception(), DeviceLostError)
        await device.close()
        del calling
        gc.collect()

    asyncio.run(play())
    assert [context["message"] for context in stray] == []


class Held:
    """Its process is not up before a file is there."""

    def __init__(self, file: Path) -> None:
        import time

        while not file.exists():
            time.sleep(0.01)

    def value(self) -> int:
        return 5

    def hang(self) -> None:
        threading.Event().wait()


@pytest.fixture
def held(ray_running: None, tmp_path: Path) -> tuple[RayDevice, Path]:
    import ray

    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])  # workers can't import test modules
    file = tmp_path / "go on"
    return RayDevice("balance", Held, file), file


@pytest.mark.ray
async def test_a_deadline_does_not_count_the_start_of_the_process(held: tuple[RayDevice, Path]) -> None:
    balance, file = held
    calls = [asyncio.create_task(balance.call("value", deadline=0.05, urgent=urgent)) for urgent in (True, False)]
    done, _ = await asyncio.wait(calls, timeout=1.0)
    assert not done, "a process that starts is neither given up nor killed"
    file.touch()
    assert await asyncio.gather(*calls) == [5, 5]
    with pytest.raises(DeviceLostError, match=r"no answer to 'hang' within 0\.\d+ s"):
        await balance.call("hang", deadline=0.05)
    await balance.close()


@pytest.mark.ray
async def test_a_process_that_never_starts_is_lost(
    held: tuple[RayDevice, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    balance, _ = held
    monkeypatch.setattr(device, "START_DEADLINE", 0.2)
    with pytest.raises(DeviceLostError, match="balance: no answer to 'value'"):
        await balance.call("value", deadline=60.0)
    await balance.close()


class Broken:
    """Its constructor fails."""

    def __init__(self, error: Exception) -> None:
        raise error

    def value(self) -> int:
        return 5


@pytest.mark.ray
@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (LaboratoryError("virtual controller at 127.0.0.2: not ready"), "virtual controller at 127.0.0.2: not ready"),
        (KeyError("mass"), "KeyError: 'mass'"),  # of a defect, the type says more than the text
    ],
)
async def test_a_process_that_does_not_start_says_why(ray_running: None, error: Exception, reason: str) -> None:
    import ray

    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])  # workers can't import test modules
    bench = RayDevice("emulators", Broken, error)
    with pytest.raises(DeviceLostError, match=f"^emulators: did not start: {re.escape(reason)}$"):
        await bench.call("value", deadline=60.0)
    await bench.close()
