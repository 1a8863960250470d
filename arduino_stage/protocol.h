// The stage line protocol, firmware half: numbered, checksummed lines in, replies out. docs/spec/stage-line.md.
#pragma once
#include <stdint.h>

#include "stage.h"

constexpr uint8_t PROTOCOL_VERSION = 2;
constexpr uint8_t MAX_LINE_BYTES = 96;  // with checksum and line end
#define FIRMWARE_VERSION "0.1.0"

// CRC-16/XMODEM, one byte: polynomial 0x1021, start 0.
uint16_t crc16_update(uint16_t crc, uint8_t byte);

// Builder of a reply.
class Line {
 public:
  Line() : length_(0) {}
  // Each appends and returns the line; what is too long is cut off.
  Line& text(const char* s);
  Line& number(int32_t value);
  Line& field(const char* name, int32_t value) { return text(" ").text(name).text("=").number(value); }
  void seal();  // append checksum and line end
  const char* bytes() const { return bytes_; }
  uint8_t length() const { return length_; }

 private:
  void put(char c);
  char bytes_[MAX_LINE_BYTES];
  uint8_t length_;
};

// Reads lines, has the stage execute them, answers, and reports ends of motions, alarms and statuses.
class Protocol {
 public:
  explicit Protocol(Stage& stage) : stage_(stage) { reset(); }
  void reset();
  // Send the line that follows a reset.
  void banner();

  // Process a received byte that is not an immediate one. True if it ended a line.
  bool receive(uint8_t byte);
  // True if the send buffer has space for an answer. Lines are processed only then, so that no reply blocks.
  static bool ready() { return hal_room() >= MAX_LINE_BYTES; }
  // Report received bytes that were lost.
  void lost() { send_error(ERROR_LINE_TOO_LONG); }
  // Let the stage work, and send what is due. Call often.
  void poll(uint32_t now_ms);

 private:
  static constexpr uint8_t MAX_ARGUMENTS = 5;  // of ROW
  // A line that was read.
  struct Request {
    uint16_t sequence, crc;
    const char* verb;  // in line_, not ended by a zero
    uint8_t verb_length, count;  // count: of arguments, also of those beyond MAX_ARGUMENTS
    int32_t arguments[MAX_ARGUMENTS];
  };
  // How the last motion command ended.
  enum Outcome : uint8_t { PENDING, DONE, ALARMED };

  // Check the line's checksum, parse and answer it.
  void take_line();
  // False if the line does not follow the protocol.
  bool parse(Request& request) const;
  // Execute the command; `motion` becomes true for one that moves the stage.
  StageError execute(const Request& request, bool& motion);
  // Check the sequence number, execute the line and answer; a repeated line is only answered.
  void answer(const Request& request);
  // Send the last answer again, and the end of its motion if it has ended.
  void repeat();
  void send_ok(uint16_t sequence, bool hello);
  void send_error(StageError error);                    // the line could not be read
  void send_error(StageError error, uint16_t sequence);
  void send_done();
  void send_alarm(StageError alarm);
  void send_status();

  Stage& stage_;
  char line_[MAX_LINE_BYTES];  // received so far
  uint8_t length_;
  bool overlong_;  // the line is too long: what follows is dropped up to its end

  // The last answered line: its repetition gets the same answer and is not executed again.
  bool greeted_, fresh_;  // greeted_: HELLO came since the reset; fresh_: it was the last line, any number may follow
  uint16_t last_sequence_, last_crc_;
  StageError last_error_;
  uint16_t motion_sequence_;  // of the last motion command
  bool last_is_motion_;  // the last line started a motion
  Outcome outcome_;
  bool end_due_, alarm_due_;  // waiting for space: the end of the last motion, an alarm
  StageError outcome_alarm_;  // that ended the last motion
};
