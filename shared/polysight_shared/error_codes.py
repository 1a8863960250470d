"""Codes of errors, so that programs and tests distinguish them without comparing sentences.

The general codes fit most cases; a package adds its own only for an error that callers or tests distinguish.
"""

from __future__ import annotations

from enum import StrEnum


class ErrorCode(StrEnum):
    """`PolysightError.code`: stable names, in lower case with hyphens, unlike the sentences of the messages."""

    OTHER = "other"

    # Files and folders
    FILE_MISSING = "file-missing"
    FILE_UNREADABLE = "file-unreadable"
    FILE_UNWRITABLE = "file-unwritable"
    FILE_DAMAGED = "file-damaged"
    # The file has another format, or belongs to another program.
    FILE_FOREIGN = "file-foreign"
    FILE_TOO_LARGE = "file-too-large"
    FILE_EXISTS = "file-exists"
    # The path leads out of the folder that it must stay in.
    PATH_OUTSIDE = "path-outside"
    DISK_FULL = "disk-full"
    VERSION_UNSUPPORTED = "version-unsupported"

    # Values given by a person or a program
    KEY_UNKNOWN = "key-unknown"
    KEY_MISSING = "key-missing"
    TYPE_WRONG = "type-wrong"
    # The value alone is invalid: out of range, of wrong form, or not finite.
    VALUE_INVALID = "value-invalid"
    # Two values that exclude each other.
    VALUES_CONFLICT = "values-conflict"
    NAME_TAKEN = "name-taken"

    # Peers and devices
    NO_ANSWER = "no-answer"
    REFUSED_BY_PEER = "refused-by-peer"
    MESSAGE_INVALID = "message-invalid"
    BUSY = "busy"
    PACKAGE_MISSING = "package-missing"

    # Data
    NO_DATA = "no-data"
    NOT_ENOUGH_DATA = "not-enough-data"
    # Two pieces of data that do not belong together.
    MISMATCH = "mismatch"

    # host/polysight/serve
    # The Host header of the request is not a name of this server.
    HOST_UNKNOWN = "host-unknown"
    # The request comes from a page of another site.
    ORIGIN_FOREIGN = "origin-foreign"
    READ_ONLY = "read-only"
    TOKEN_WRONG = "token-wrong"

    # host/polysight/acquisition
    # A row is still incomplete after its last retake.
    ROW_INCOMPLETE = "row-incomplete"
    # The stage is not homed, has a fault, or belongs to another host.
    STAGE_NOT_READY = "stage-not-ready"
    # The Pi's configuration of the stage would put rows at other positions than the host's.
    STAGE_DIFFERS = "stage-differs"

    # Radar
    RADAR_RESTARTED = "radar-restarted"
    RADAR_NO_FIRMWARE = "radar-no-firmware"
    # The radar reported a fatal event, or failed its self-test.
    RADAR_FAULT = "radar-fault"
