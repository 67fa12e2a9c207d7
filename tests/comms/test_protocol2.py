"""The one codec of Dynamixel Protocol 2.0, against the manual's bytes, ROBOTIS' own SDK, and any noise."""

from __future__ import annotations

import itertools

import dynamixel_sdk as sdk
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openant_tools.comms import protocol2 as p2
from openant_tools.comms.protocol2 import Garbage, Instruction, JoinedAnswer, JoinedStatus, Parser, Reason, Status

ANT = (10, 11, 20, 21, 30, 31, 40, 41)


def raw(text: str) -> bytes:
    """`…` stands for the header."""
    return bytes.fromhex(text.replace("…", "FF FF FD 00").replace(" ", ""))


INSTRUCTIONS = [
    (p2.ping(1), "… 01 03 00 01 19 4E"),
    (p2.ping(p2.BROADCAST), "… FE 03 00 01 31 42"),
    (p2.read(1, 132, 4), "… 01 07 00 02 84 00 04 00 1D 15"),
    (p2.write(1, 116, (512).to_bytes(4, "little")), "… 01 09 00 03 74 00 00 02 00 00 CA 89"),
    (p2.reg_write(1, 104, (200).to_bytes(4, "little")), "… 01 09 00 04 68 00 C8 00 00 00 AE 8E"),
    (p2.action(1), "… 01 03 00 05 02 CE"),
    (p2.reboot(1), "… 01 03 00 08 2F 4E"),
    (p2.factory_reset(1, 0x01), "… 01 04 00 06 01 A1 E6"),
    (p2.clear_multi_turn(1), "… 01 08 00 10 01 44 58 4C 22 B1 DC"),
    (p2.sync_read(132, 4, (1, 2)), "… FE 09 00 82 84 00 04 00 01 02 CE FA"),
    (
        p2.sync_write(116, 4, {1: bytes((150, 0, 0, 0)), 2: bytes((170, 0, 0, 0))}),
        "… FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87",
    ),
    (p2.fast_sync_read(132, 4, (3, 7, 4)), "… FE 0A 00 8A 84 00 04 00 03 07 04 20 F2"),
    (p2.write(1, 116, bytes.fromhex("FFFFFD00")), "… 01 0A 00 03 74 00 FF FF FD FD 00 21 E7"),
    (p2.write(1, 116, bytes.fromhex("FFFFFDFD")), "… 01 0A 00 03 74 00 FF FF FD FD FD 2C 65"),
    (p2.write(1, 7, b"\x0a"), "… 01 06 00 03 07 00 0A 8E E3"),
    (p2.write(10, 8, b"\x03"), "… 0A 06 00 03 08 00 03 C7 68"),
    (p2.sync_read(120, 27, ANT), "… FE 0F 00 82 78 00 1B 00 0A 0B 14 15 1E 1F 28 29 56 2B"),
    (p2.fast_sync_read(120, 27, ANT), "… FE 0F 00 8A 78 00 1B 00 0A 0B 14 15 1E 1F 28 29 5F 57"),
    (
        p2.sync_write(64, 1, dict.fromkeys(ANT, b"\0")),
        "… FE 17 00 83 40 00 01 00 0A 00 0B 00 14 00 15 00 1E 00 1F 00 28 00 29 00 34 33",
    ),
    (p2.write(10, 98, b"\x0a"), "… 0A 06 00 03 62 00 0A F9 6F"),
    (p2.reboot(p2.BROADCAST), "… FE 03 00 08 07 42"),
]
# The manual misprints the CRCs of "restore EEPROM" and of the Fast Bulk Read example; these are the right ones.
CORRECTED = [(p2.control_table_restore(1), "9E F5")]

STATUSES = [
    (Status(1, 0, bytes.fromhex("060426")), "… 01 07 00 55 00 06 04 26 65 5D"),
    (Status(1, 0, (166).to_bytes(4, "little")), "… 01 08 00 55 00 A6 00 00 00 8C C0"),
    (Status(1), "… 01 04 00 55 00 A1 0C"),
    (Status(1, 0, bytes.fromhex("24042F")), "… 01 07 00 55 00 24 04 2F FB 5F"),
    (Status(11, 0, bytes.fromhex("FC032F")), "… 0B 07 00 55 00 FC 03 2F 24 63"),
    (Status(10, p2.Error.ACCESS), "… 0A 04 00 55 07 FB 0F"),
    (Status(11, p2.ALERT_BIT, b"\x51"), "… 0B 05 00 55 80 51 B5 10"),
]
JOINED = raw("FF FF FD 00 FE 19 00 55 00 03 A6 00 00 00 84 08 00 07 1F 08 00 00 16 CA 00 04 FF 03 00 00 D1 9E")


@pytest.mark.parametrize(("packet", "text"), [*INSTRUCTIONS, *STATUSES])
def test_every_published_example_both_ways(packet: Instruction | Status, text: str) -> None:
    assert packet.encode() == raw(text)
    assert Parser().feed(raw(text)) == [packet]


@pytest.mark.parametrize(("packet", "crc"), CORRECTED)
def test_misprinted_examples_have_the_right_checksum(packet: Instruction, crc: str) -> None:
    assert packet.encode()[-2:] == raw(crc)


def test_check_value_of_the_crc() -> None:
    assert p2.crc16(b"123456789") == 0xFEE8
    assert p2.crc16(b"6789", p2.crc16(b"12345")) == 0xFEE8


def test_alert_is_not_a_refusal() -> None:
    status = Status(11, 0x80, b"\x51")
    assert status.alert
    assert status.code == p2.Error.OK
    assert Status(11, 0x87).code == p2.Error.ACCESS


def test_joined_reply_of_the_manual() -> None:
    parts = [JoinedAnswer(id, 0, value.to_bytes(4, "little")) for id, value in ((3, 166), (7, 2079), (4, 1023))]
    assert b"".join(p2.encode_joined(parts)) == JOINED
    assert p2.split_joined(JOINED, [(3, 4), (7, 4), (4, 4)]) == parts
    assert Parser().feed(JOINED) == [JoinedStatus(JOINED)]


def test_joined_reply_keeps_what_came_before_the_silent_servo() -> None:
    asked = [(3, 4), (7, 4), (4, 4)]
    for end in range(len(JOINED)):
        got = p2.split_joined(JOINED[:end], asked)
        assert [answer.id for answer in got] == [3, 7, 4][: (end >= 16) + (end >= 24)]
    broken = bytearray(JOINED)
    broken[19] ^= 1
    assert [answer.id for answer in p2.split_joined(bytes(broken), asked)] == [3]


def test_a_lost_byte_costs_one_packet_only() -> None:
    first, second = (status.encode() for status, _ in STATUSES[:2])
    for lost in range(len(first)):
        parser = Parser()
        got = parser.feed(first[:lost] + first[lost + 1 :] + second) + parser.flush()
        assert got[-1] == STATUSES[1][0]
        assert all(isinstance(item, Garbage) for item in got[:-1])


def test_a_length_that_grew_does_not_swallow_the_answers_behind_it() -> None:
    stream = bytearray(STATUSES[0][0].encode() + STATUSES[1][0].encode())
    stream[6] = 1  # LEN 263
    got = Parser().feed(stream)
    assert isinstance(got[0], Garbage)
    assert got[0].reason is Reason.SHORT
    assert got[0].id == 1
    assert got[1] == STATUSES[1][0]


def test_a_packet_that_breaks_off_is_reported_when_the_line_is_quiet() -> None:
    parser = Parser()
    assert parser.feed(STATUSES[0][0].encode()[:-1]) == []
    [got] = parser.flush()
    assert isinstance(got, Garbage)
    assert (got.reason, got.id) == (Reason.SHORT, 1)
    assert parser.pending == 0


def test_an_unstuffed_packet_is_not_taken_for_good() -> None:
    sdk_bytes = raw("… 01 09 00 03 74 00 FF FF FD 00 C9 07")
    parser = Parser()
    got = parser.feed(sdk_bytes) + parser.flush()
    assert all(isinstance(item, Garbage) for item in got)
    body = bytes.fromhex("03 74 00 FF FF FD 05")
    packet = p2.HEADER + bytes((1, len(body) + 2, 0)) + body
    [broken] = Parser().feed(packet + p2.crc16(packet).to_bytes(2, "little"))
    assert isinstance(broken, Garbage)
    assert broken.reason is Reason.UNSTUFFED


# ---- against ROBOTIS' own SDK ------------------------------------------------------------------------------------


class Recorder(sdk.PortHandler):  # type: ignore[misc]
    """A port of the SDK that keeps what is sent and answers from a store."""

    def __init__(self, answers: bytes = b"") -> None:
        super().__init__("")
        self.sent = b""
        self.answers = answers
        self.is_using = False
        self.baudrate = 1_000_000

    def writePort(self, packet: list[int]) -> int:
        self.sent += bytes(packet)
        return len(packet)

    def readPort(self, length: int) -> bytes:
        got, self.answers = self.answers[:length], self.answers[length:]
        return got

    def clearPort(self) -> None:
        pass

    def setPacketTimeout(self, length: int) -> None:
        pass

    def isPacketTimeout(self) -> bool:
        return not self.answers


values = st.binary(min_size=1, max_size=40).filter(lambda data: b"\xff\xff\xfd" not in data)
ids = st.integers(0, p2.MAX_ID)


@given(ids, st.integers(0, 661), values)
def test_writes_equal_the_sdk_byte_for_byte(id: int, address: int, data: bytes) -> None:
    port, packets = Recorder(), sdk.PacketHandler(2.0)
    packets.writeTxOnly(port, id, address, len(data), list(data))
    if b"\xff\xff\xfd" not in address.to_bytes(2, "little") + data:
        assert p2.write(id, address, data).encode() == port.sent


@given(ids, st.integers(0, 661), st.integers(1, 200))
def test_reads_equal_the_sdk_byte_for_byte(id: int, address: int, count: int) -> None:
    port, packets = Recorder(), sdk.PacketHandler(2.0)
    packets.readTx(port, id, address, count)
    assert p2.read(id, address, count).encode() == port.sent


@given(st.lists(ids, min_size=1, max_size=20, unique=True), st.integers(0, 661), st.integers(1, 60), st.booleans())
def test_sync_reads_equal_the_sdk_byte_for_byte(several: list[int], address: int, count: int, fast: bool) -> None:
    port, packets = Recorder(), sdk.PacketHandler(2.0)
    packets.syncReadTx(port, address, count, several, len(several), fast)
    expected = (p2.fast_sync_read if fast else p2.sync_read)(address, count, several)
    if p2.stuff(expected.params) == expected.params:
        assert expected.encode() == port.sent


@given(ids, st.integers(0, 255), st.binary(max_size=60))
def test_the_sdk_reads_our_statuses(id: int, error: int, params: bytes) -> None:
    packets = sdk.PacketHandler(2.0)
    packet, result = packets.rxPacket(Recorder(Status(id, error, params).encode()), False)
    assert result == sdk.COMM_SUCCESS
    assert packet[4] == id
    assert bytes(packet[8:-2])[: 1 + len(params)] == bytes((error,)) + params


# ---- any bytes ---------------------------------------------------------------------------------------------------

# Bytes that make headers, stuffing and error codes likely.
nasty = st.lists(st.sampled_from([0xFF, 0xFF, 0xFD, 0x00, 0x55, 0xFE, 0x01, 0x03, 0x04, 0x80]), max_size=60).map(bytes)
instructions = st.builds(
    Instruction,
    st.one_of(ids, st.just(p2.BROADCAST)),
    st.integers(0, 255).filter(lambda code: code != p2.Inst.STATUS),
    st.one_of(nasty, st.binary(max_size=60)),
)
statuses = st.builds(Status, ids, st.integers(0, 255), st.one_of(nasty, st.binary(max_size=60)))
packets_ = st.one_of(instructions, statuses)


def in_pieces(stream: bytes, cuts: list[int]) -> list[bytes]:
    edges = [0, *sorted(cut % (len(stream) + 1) for cut in cuts), len(stream)]
    return [stream[a:b] for a, b in itertools.pairwise(edges)]


def check(stream: bytes, cuts: list[int]) -> list[Instruction | Status | JoinedStatus | Garbage]:
    """Feed in pieces; whatever is reported as good stands in the stream as a whole packet, and no byte is lost."""
    parser = Parser()
    got = [item for piece in in_pieces(stream, cuts) for item in parser.feed(piece)] + parser.flush()
    assert parser.pending == 0
    pieces = [
        item.data if isinstance(item, Garbage) else item.raw if isinstance(item, JoinedStatus) else item.encode()
        for item in got
    ]
    assert b"".join(pieces) == stream
    return got


@given(st.lists(packets_, max_size=6), st.lists(st.integers(0, 400), max_size=8))
def test_round_trip_in_any_portions(sent: list[Instruction | Status], cuts: list[int]) -> None:
    assert check(b"".join(packet.encode() for packet in sent), cuts) == sent


@given(st.one_of(nasty, st.binary(max_size=300)), st.lists(st.integers(0, 400), max_size=8))
@settings(max_examples=300)
def test_any_bytes(stream: bytes, cuts: list[int]) -> None:
    check(stream, cuts)


@given(
    st.lists(packets_, min_size=1, max_size=5),
    st.lists(
        st.tuples(st.sampled_from(["flip", "cut", "insert"]), st.integers(0, 600), st.integers(1, 255)), max_size=4
    ),
    st.lists(st.integers(0, 400), max_size=8),
)
@settings(max_examples=300)
def test_mutated_streams(
    sent: list[Instruction | Status], mutations: list[tuple[str, int, int]], cuts: list[int]
) -> None:
    stream = bytearray(b"".join(packet.encode() for packet in sent))
    for what, where, value in mutations:
        at = where % (len(stream) + 1)
        if what == "insert":
            stream.insert(at, value)
        elif at < len(stream):
            if what == "flip":
                stream[at] ^= value
            else:
                del stream[at]
    check(bytes(stream), cuts)


@given(packets_, st.integers(0, 600), st.integers(1, 255), packets_)
def test_one_wrong_byte_never_passes_and_the_next_packet_does(
    broken: Instruction | Status, where: int, value: int, good: Instruction | Status
) -> None:
    stream = bytearray(broken.encode())
    stream[where % len(stream)] ^= value
    got = check(bytes(stream) + good.encode(), [])
    assert got[-1] == good
    assert all(isinstance(item, Garbage) for item in got[:-1])


def test_noise_is_not_kept() -> None:
    parser = Parser()
    for _ in range(100):
        parser.feed(b"\xff\xff\xfd\x00\x01\xff\x03" + bytes(500))
        assert parser.pending <= p2.MAX_PACKET
