"""MSP: the vectors of the field, and whatever bytes a cable may deliver."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openant_tools.comms import msp
from openant_tools.comms.msp import Direction, Framing, MspFrame, MspParser

RAW_IMU = msp.RawImu((0, 0, 2048), (-16, 0, 16))
ATTITUDE = msp.Attitude(-15, 20, 270)

VECTORS = [
    ("24 4D 3C 00 66 66", MspFrame(Direction.REQUEST, 102)),
    ("24 4D 3C 00 6C 6C", MspFrame(Direction.REQUEST, 108)),
    ("24 4D 3C 00 01 01", MspFrame(Direction.REQUEST, 1)),
    ("24 4D 3C 02 E6 66 6C EE", MspFrame(Direction.REQUEST, 230, bytes([102, 108]))),
    ("24 58 3C 00 66 00 00 00 05", MspFrame(Direction.REQUEST, 102, framing=Framing.V2)),
    (
        "24 4D 3E 12 66 00 00 00 00 00 08 F0 FF 00 00 10 00 00 00 00 00 00 00 63",
        MspFrame(Direction.REPLY, 102, RAW_IMU.encode()),
    ),
    ("24 4D 3E 06 6C F1 FF 14 00 0E 01 7F", MspFrame(Direction.REPLY, 108, ATTITUDE.encode())),
    ("24 58 3E 00 6C 00 06 00 F1 FF 14 00 0E 01 70", MspFrame(Direction.REPLY, 108, ATTITUDE.encode(), Framing.V2)),
    ("24 4D 3E 03 01 00 01 2E 2D", MspFrame(Direction.REPLY, 1, msp.ApiVersion(0, 1, 46).encode())),
]


@st.composite
def frames(draw: st.DrawFn) -> MspFrame:
    framing = draw(st.sampled_from(Framing))
    direction = draw(st.sampled_from(Direction))
    longest = 240 if direction is Direction.REQUEST else 600
    # In v1 the number 255 means v2 over v1, so it is no command of its own.
    command = draw(st.integers(0, 254 if framing is Framing.V1 else 0xFFFF))
    flags = 0 if framing is Framing.V1 else draw(st.integers(0, 255))
    return MspFrame(direction, command, draw(st.binary(max_size=longest)), framing, flags)


def cut(data: bytes, sizes: list[int]) -> list[bytes]:
    parts, at = [], 0
    for size in sizes:
        parts.append(data[at : at + size])
        at += size
    return [*parts, data[at:]]


@pytest.mark.parametrize(("text", "frame"), VECTORS)
def test_frames_of_the_field_are_read_and_written_byte_for_byte(text: str, frame: MspFrame) -> None:
    data = bytes.fromhex(text)
    assert msp.encode(frame) == data
    assert MspParser().feed(data) == [frame]


def test_the_checksum_of_v2_is_dvb_s2() -> None:
    assert msp.crc8_dvb_s2(b"123456789") == 0xBC


@given(st.lists(frames(), max_size=4), st.lists(st.integers(0, 40), max_size=30))
def test_every_frame_survives_any_portions(sent: list[MspFrame], sizes: list[int]) -> None:
    parser = MspParser()
    stream = b"".join(msp.encode(frame) for frame in sent)
    assert [frame for part in cut(stream, sizes) for frame in parser.feed(part)] == sent
    assert parser.clean
    assert parser.broken == 0


@given(st.binary(max_size=400), st.lists(st.integers(0, 40), max_size=10), st.booleans())
def test_any_bytes_neither_raise_nor_invent_a_frame(data: bytes, sizes: list[int], rescan: bool) -> None:
    parser = MspParser(rescan=rescan)
    found = [frame for part in cut(data, sizes) for frame in parser.feed(part)]
    at = 0
    for frame in found:  # each frame stands in the stream as it would be sent, in order and without overlap
        at = data.index(msp.encode(frame), at) + len(msp.encode(frame))


@given(st.lists(st.sampled_from([b"$M>", b"$X>", b"$M<\x00ff", b"$M>\xffff\x10", b"$", b"$X<\x00f\x00\xff\xff"])))
def test_bytes_that_look_like_headers_do_not_stop_the_parser(pieces: list[bytes]) -> None:
    parser = MspParser()
    parser.feed(b"".join(pieces))
    good = msp.encode(MspFrame(Direction.REPLY, 108, ATTITUDE.encode()))
    # A header that claims much is believed until its bytes have come; then the frames behind it are found.
    found = [f for _ in range(1000) for f in parser.feed(good)]
    assert found[-1] == MspFrame(Direction.REPLY, 108, ATTITUDE.encode())
    assert len(found) > 500


@given(st.sampled_from(Framing), st.data())
def test_one_wrong_byte_never_passes_as_a_measurement(framing: Framing, data: st.DataObject) -> None:
    frame = MspFrame(Direction.REPLY, 102, RAW_IMU.encode(), framing)
    raw = bytearray(msp.encode(frame))
    at = data.draw(st.integers(0, len(raw) - 1))
    raw[at] ^= data.draw(st.integers(1, 255))
    for found in MspParser().feed(bytes(raw) + msp.encode(frame)):
        if found.direction is Direction.REPLY and found.command == 102 and len(found.payload) == 18:
            assert found.payload == frame.payload


@given(st.sampled_from(Framing), st.data())
def test_a_lost_or_inserted_byte_leaves_the_exchange_unclean(framing: Framing, data: st.DataObject) -> None:
    raw = bytearray(msp.encode(MspFrame(Direction.REPLY, 102, RAW_IMU.encode(), framing)))
    parser = MspParser()
    assert parser.feed(bytes(raw)) != []
    assert parser.clean
    at = data.draw(st.integers(0, len(raw) - 1))
    if data.draw(st.booleans()):
        del raw[at]
    else:
        raw.insert(at, data.draw(st.integers(0, 255).filter(lambda byte: byte != raw[at])))
    parser.reset()
    assert parser.clean
    frames = parser.feed(bytes(raw))
    assert not frames or not parser.clean


def test_a_host_finds_the_frame_behind_a_broken_one_and_a_device_drops_it_whole() -> None:
    good = bytes.fromhex(VECTORS[6][0])
    broken = bytes.fromhex("24 4D 3E 12 66") + good + bytes(7)  # claims 18 bytes; a whole frame stands within them
    host, device = MspParser(), MspParser(rescan=False)
    assert [f.command for f in host.feed(broken)] == [108]
    assert device.feed(broken) == []
    assert host.broken == device.broken == 1


def test_bytes_outside_frames_are_counted() -> None:
    parser = MspParser()
    parser.feed(b"# " + bytes.fromhex(VECTORS[0][0]) + b"R")
    assert parser.stray == 3
    assert not parser.clean


def test_a_device_believes_no_request_longer_than_its_buffer() -> None:
    device = MspParser(msp.DEVICE_RECEIVE_LIMIT, rescan=False)
    assert device.feed(msp.request(1, bytes(193))) == []
    assert [f.command for f in device.feed(msp.request(1, bytes(192)))] == [1]


def test_long_replies_are_jumbo_frames_and_long_requests_are_refused() -> None:
    reply = msp.encode(MspFrame(Direction.REPLY, 116, bytes(300)))
    assert reply[3] == 255
    assert MspParser().feed(reply)[0].payload == bytes(300)
    with pytest.raises(ValueError, match="only replies may be longer than 254"):
        msp.request(116, bytes(255))
    with pytest.raises(ValueError, match="carries no command 300"):
        msp.request(300)


i16 = st.integers(-32768, 32767)
triples = st.tuples(i16, i16, i16)
texts = st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=20)
u8, u16, u32 = st.integers(0, 255), st.integers(0, 65535), st.integers(0, 2**32 - 1)


@given(
    st.one_of(
        st.builds(msp.ApiVersion, u8, u8, u8),
        st.builds(msp.FcVersion, u8, u8, u8, texts),
        st.builds(msp.BoardAlignment, i16, i16, i16),
        st.builds(msp.FlightStatus, u16, u16, u16, u32, u8, u16, st.binary(max_size=9)),
        st.builds(msp.RawImu, triples, triples, triples),
        st.builds(msp.Attitude, i16, i16, i16),
        st.builds(msp.Uid, st.tuples(u32, u32, u32)),
        st.builds(
            msp.BoardInfo,
            st.text(st.characters(min_codepoint=65, max_codepoint=90), min_size=4, max_size=4),
            *(u16, u8, u8, texts, texts, texts, st.binary(min_size=32, max_size=32), u8, u8, u16, u32, u8, u8),
        ),
    )
)
def test_messages_survive_the_wire(message: msp.ApiVersion) -> None:
    assert type(message).decode(message.encode()) == message


MESSAGES = [
    msp.ApiVersion, msp.FcVersion, msp.BoardInfo, msp.BoardAlignment, msp.FlightStatus, msp.RawImu, msp.Attitude,
    msp.AttitudeQuaternion, msp.Analog, msp.Altitude, msp.Uid,
]  # fmt: skip


@given(st.sampled_from(MESSAGES), st.binary(max_size=120))
def test_any_payload_is_a_message_or_an_error_that_names_it(kind: type[msp.ApiVersion], payload: bytes) -> None:
    message = ""
    try:
        kind.decode(payload)
    except msp.MspError as error:
        message = str(error)
    assert message == "" or message.startswith("the reply to")


def test_board_info_is_read_as_far_as_the_firmware_sends_it() -> None:
    whole = msp.BoardInfo("KAKU", 7, 0, 0, "KAKUTEH7MINI", "H7", "HBRO", bytes(32), 9, 2, 8000, 1, 2, 1)
    assert whole.accelerometer_uncalibrated
    old = whole.encode()[:8]
    assert msp.BoardInfo.decode(old) == msp.BoardInfo("KAKU", 7)
    with pytest.raises(msp.MspError, match=r"the reply to BOARD_INFO \(4\) ends after 12 bytes"):
        msp.BoardInfo.decode(whole.encode()[:12])


def test_several_messages_in_one_reply_must_add_up() -> None:
    payload = msp.encode_multiple([RAW_IMU.encode(), ATTITUDE.encode()])
    assert msp.decode_multiple([102, 108], payload) == [RAW_IMU.encode(), ATTITUDE.encode()]
    with pytest.raises(msp.MspError, match="7 bytes too many"):
        msp.decode_multiple([102], payload)
    with pytest.raises(msp.MspError, match="ends after"):
        msp.decode_multiple([102, 108], payload[:-1])
    with pytest.raises(msp.MspError, match="has 17 bytes where 18 belong"):
        msp.RawImu.decode(RAW_IMU.encode()[:-1])


def test_the_accelerometer_scale_follows_the_firmware() -> None:
    assert msp.acc_scales(msp.ApiVersion(0, 1, 45)) == (512,)
    assert msp.acc_scales(msp.ApiVersion(0, 1, 46)) == (2048, 1024, 4096)


@settings(max_examples=30)
@given(st.binary(max_size=3000))
def test_the_parser_holds_no_more_than_one_largest_frame(data: bytes) -> None:
    parser = MspParser(limit=64)
    parser.feed(data)
    assert len(parser._buffer) < 64 + 9
