"""The vendor's own DynamixelSDK behind our questions: a second opinion on the same bus. It reads and never writes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from types import TracebackType
from typing import Self

from openant_tools.comms.bus import FoundServo
from openant_tools.comms.line import SerialLine
from openant_tools.errors import HardwareFault

__all__ = ["VendorSdk"]


class VendorSdk:
    """One bus as the vendor's SDK sees it. Where it gets no answer, its own words say why.

    Attributes:
        asked, lost: by id; how often, and its words → how often.

    Raises:
        HardwareFault: the port does not open.
    """

    def __init__(self, path: str, baud: int) -> None:
        from dynamixel_sdk import PacketHandler, PortHandler

        SerialLine(path, baud).close()  # which says why it does not open; the SDK takes no heed of who holds it
        self.asked: Counter[int] = Counter()
        self.lost: dict[int, Counter[str]] = {}
        self._port, self._packets = PortHandler(path), PacketHandler(2.0)
        if not self._port.setBaudRate(baud):
            raise HardwareFault(
                f"the vendor's SDK does not know {baud} baud", where=path, remedy="ask with --driver own"
            )

    def ping(self, id: int, tries: int = 1) -> FoundServo | None:
        """Who has this id; None where nobody answers the SDK."""
        for _ in range(tries):
            model, result, error = self._packets.ping(self._port, id)
            if self._good(id, result):
                firmware = self.read(id, 6, 1, tries)
                return FoundServo(id, model, firmware[0] if firmware else 0, bool(error & 0x80))
        return None

    def read(self, id: int, address: int, size: int, tries: int = 1) -> bytes | None:
        """Registers of one servo; None where the SDK got none."""
        for _ in range(tries):
            data, result, error = self._packets.readTxRx(self._port, id, address, size)
            if not self._good(id, result) or error & 0x7F:
                continue
            if len(data) == size:
                return bytes(data)
            # The SDK takes whatever comes next for the answer: this one was late, and to another question.
            self.lost.setdefault(id, Counter())[f"{len(data)} bytes instead of {size}"] += 1
        return None

    def sync_read(self, ids: Sequence[int], address: int, size: int) -> dict[int, bytes]:
        """The same registers of several servos. The SDK gives up at the first that is silent: who stands behind it in the
        request is asked alone."""
        from dynamixel_sdk import GroupSyncRead

        group = GroupSyncRead(self._port, self._packets, address, size)
        for id in ids:
            group.addParam(id)
        group.txRxPacket()
        found: dict[int, bytes] = {}
        for id in ids:
            if group.isAvailable(id, address, size):
                self.asked[id] += 1
                found[id] = bytes(group.getData(id, at, 1) for at in range(address, address + size))
            elif (data := self.read(id, address, size)) is not None:
                found[id] = data
        return found

    def _good(self, id: int, result: int) -> bool:
        from dynamixel_sdk import COMM_SUCCESS

        self.asked[id] += 1
        if result == COMM_SUCCESS:
            return True
        words = self._packets.getTxRxResult(result).removeprefix("[TxRxResult]").strip(" []!")
        self.lost.setdefault(id, Counter())[words] += 1
        return False

    def why(self, id: int) -> str:
        """The SDK's words for what it lost of a servo."""
        return ", ".join(f"{words} ({count})" for words, count in self.lost.get(id, Counter()).items())

    def close(self) -> None:
        """Give the port back."""
        if self._port.is_open:
            self._port.closePort()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self.close()
