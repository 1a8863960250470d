#include "protocol.h"

#include <string.h>

uint16_t crc16_update(uint16_t crc, uint8_t byte) {
  crc ^= (uint16_t)byte << 8;
  for (uint8_t i = 0; i < 8; i++) crc = crc & 0x8000 ? (uint16_t)(crc << 1 ^ 0x1021) : (uint16_t)(crc << 1);
  return crc;
}

namespace {

const char HEX_DIGITS[] = "0123456789ABCDEF";
constexpr uint8_t TAIL = 5;  // `*` and four digits

uint16_t crc16(const char* bytes, uint8_t length) {
  uint16_t crc = 0;
  for (uint8_t i = 0; i < length; i++) crc = crc16_update(crc, (uint8_t)bytes[i]);
  return crc;
}

bool digit(char c) { return c >= '0' && c <= '9'; }

}  // namespace

void Line::put(char c) {
  if (length_ < MAX_LINE_BYTES) bytes_[length_++] = c;
}

Line& Line::text(const char* s) {
  while (*s) put(*s++);
  return *this;
}

Line& Line::number(int32_t value) {
  char digits[10];
  uint8_t n = 0;
  uint32_t left = value < 0 ? -(uint32_t)value : (uint32_t)value;
  do {
    digits[n++] = (char)('0' + left % 10);
    left /= 10;
  } while (left);
  if (value < 0) put('-');
  while (n) put(digits[--n]);
  return *this;
}

void Line::seal() {
  const uint16_t crc = crc16(bytes_, length_);
  put('*');
  for (int8_t shift = 12; shift >= 0; shift -= 4) put(HEX_DIGITS[crc >> shift & 15]);
  put('\n');
}

static void send(Line& line) {
  line.seal();
  hal_write(line.bytes(), line.length());
}

void Protocol::reset() {
  length_ = 0;
  overlong_ = greeted_ = fresh_ = last_is_motion_ = end_due_ = alarm_due_ = false;
  last_sequence_ = last_crc_ = motion_sequence_ = 0;
  last_error_ = outcome_alarm_ = ERROR_NONE;
  outcome_ = PENDING;
}

void Protocol::banner() {
  Line line;
  line.text("polysight-stage fw=" FIRMWARE_VERSION).field("proto", PROTOCOL_VERSION);
  send(line);
}

bool Protocol::receive(uint8_t byte) {
  if (byte == '\n') {
    if (overlong_) {
      send_error(ERROR_LINE_TOO_LONG);
    } else if (length_) {
      take_line();
    }
    length_ = 0;
    overlong_ = false;
    return true;
  }
  if (length_ < MAX_LINE_BYTES - 1) {
    line_[length_++] = (char)byte;
  } else {
    overlong_ = true;
  }
  return false;
}

void Protocol::take_line() {
  if (length_ < TAIL || line_[length_ - TAIL] != '*') return send_error(ERROR_MALFORMED);
  const uint8_t body = length_ - TAIL;
  const uint16_t crc = crc16(line_, body);
  for (uint8_t i = 0; i < 4; i++) {
    if (line_[body + 1 + i] != HEX_DIGITS[crc >> (12 - 4 * i) & 15]) return send_error(ERROR_BAD_CRC);
  }
  length_ = body;
  Request request;
  request.crc = crc;
  if (!parse(request)) return send_error(ERROR_MALFORMED);
  stage_.heard();
  answer(request);
}

// `N<sequence> <VERB>[ <integer>]...`, single spaces.
bool Protocol::parse(Request& request) const {
  const char* p = line_;
  const char* const end = line_ + length_;
  if (p == end || *p++ != 'N') return false;
  uint32_t sequence = 0;
  uint8_t digits = 0;
  for (; p < end && digit(*p) && digits < 5; p++, digits++) sequence = sequence * 10 + (uint8_t)(*p - '0');
  if (digits == 0 || sequence > 65535 || p == end || *p++ != ' ') return false;
  request.sequence = (uint16_t)sequence;
  request.verb = p;
  while (p < end && *p >= 'A' && *p <= 'Z') p++;
  request.verb_length = (uint8_t)(p - request.verb);
  if (request.verb_length == 0) return false;
  for (request.count = 0; p < end; request.count++) {
    if (*p++ != ' ') return false;
    const bool negative = p < end && *p == '-';
    if (negative) p++;
    const uint32_t largest = negative ? 0x80000000UL : 0x7FFFFFFFUL;
    uint32_t value = 0;
    for (digits = 0; p < end && digit(*p); p++, digits++) {
      const uint8_t d = (uint8_t)(*p - '0');
      if (digits == 10 || value > 214748364UL) return false;
      value = value * 10 + d;
      if (value > largest) return false;
    }
    if (digits == 0) return false;
    if (request.count < MAX_ARGUMENTS) request.arguments[request.count] = (int32_t)(negative ? 0 - value : value);
  }
  return true;
}

void Protocol::answer(const Request& request) {
  const bool hello = request.verb_length == 5 && memcmp(request.verb, "HELLO", 5) == 0;
  if (!hello) {
    if (!greeted_) return send_error(ERROR_SEQUENCE, request.sequence);
    if (!fresh_) {
      if (request.sequence == last_sequence_ && request.crc == last_crc_) return repeat();
      if (request.sequence != (uint16_t)(last_sequence_ + 1)) return send_error(ERROR_SEQUENCE, request.sequence);
    }
  }
  bool motion = false;
  const StageError error = execute(request, motion);
  last_sequence_ = request.sequence;
  last_crc_ = request.crc;
  last_error_ = error;
  last_is_motion_ = motion && error == ERROR_NONE;
  fresh_ = hello && error == ERROR_NONE;
  if (last_is_motion_) {
    motion_sequence_ = request.sequence;
    outcome_ = PENDING;
  }
  if (error != ERROR_NONE) return send_error(error, request.sequence);
  if (hello) greeted_ = true;
  send_ok(request.sequence, hello);
}

StageError Protocol::execute(const Request& request, bool& motion) {
  struct Verb {
    const char* name;
    uint8_t count;
  };
  static const Verb VERBS[] = {{"HELLO", 0}, {"SET", 2}, {"ENABLE", 1}, {"HOME", 0},
                               {"MOVE", 3},  {"ROW", 5}, {"BUZZ", 1},   {"CLEAR", 0}};
  constexpr uint8_t N_VERBS = sizeof VERBS / sizeof VERBS[0];
  uint8_t i = 0;
  while (i < N_VERBS && (strlen(VERBS[i].name) != request.verb_length ||
                         memcmp(VERBS[i].name, request.verb, request.verb_length) != 0)) {
    i++;
  }
  if (i == N_VERBS) return ERROR_UNKNOWN_COMMAND;
  if (request.count != VERBS[i].count) return ERROR_ARGUMENT_COUNT;
  const int32_t* a = request.arguments;
  motion = i >= 3 && i <= 6;
  switch (i) {
    case 1:
      return stage_.set(a[0], a[1]);
    case 2:
      return stage_.enable(a[0]);
    case 3:
      return stage_.home();
    case 4:
      return stage_.move(a[0], a[1], a[2]);
    case 5:
      return stage_.row(a[0], a[1], a[2], a[3], a[4]);
    case 6:
      return stage_.buzz(a[0]);
    case 7:
      return stage_.clear();
    default:
      return ERROR_NONE;  // HELLO
  }
}

void Protocol::repeat() {
  if (last_error_ != ERROR_NONE) return send_error(last_error_, last_sequence_);
  send_ok(last_sequence_, false);
  end_due_ = last_is_motion_ && outcome_ != PENDING;
}

void Protocol::poll(uint32_t now_ms) {
  const Event event = stage_.service(now_ms);
  if (event == EVENT_DONE) {
    outcome_ = DONE;
    end_due_ = true;
  } else if (event == EVENT_ALARM) {
    if (outcome_ == PENDING) {
      outcome_ = ALARMED;
      outcome_alarm_ = stage_.alarm();
    }
    alarm_due_ = true;
  }
  if (end_due_ && ready()) {
    end_due_ = false;
    outcome_ == DONE ? send_done() : send_alarm(outcome_alarm_);
  }
  if (alarm_due_ && ready()) {
    alarm_due_ = false;
    send_alarm(stage_.alarm());
  }
  if (ready() && stage_.take_status_request()) send_status();
}

void Protocol::send_ok(uint16_t sequence, bool hello) {
  Line line;
  line.text("ok N").number(sequence);
  if (hello) {
    line.text(" fw=" FIRMWARE_VERSION).field("proto", PROTOCOL_VERSION).field("steps", hal_steps_per_mm());
  }
  send(line);
}

void Protocol::send_error(StageError error) {
  Line line;
  line.text("error:").number(error).text(" N-");
  send(line);
}

void Protocol::send_error(StageError error, uint16_t sequence) {
  Line line;
  line.text("error:").number(error).text(" N").number(sequence);
  send(line);
}

void Protocol::send_done() {
  const Motion& m = stage_.motion();
  Line line;
  line.text("done N").number(motion_sequence_);
  if (stage_.in_row()) line.field("points", m.points()).field("pulses", m.pulses());
  line.field("x", m.x()).field("y", m.y());
  if (stage_.in_row()) line.field("held", stage_.held());
  if (stage_.homing()) line.field("lostx", stage_.lost_x()).field("losty", stage_.lost_y());
  send(line);
}

void Protocol::send_alarm(StageError alarm) {
  Line line;
  line.text("alarm:").number(alarm);
  send(line);
}

void Protocol::send_status() {
  const Motion& m = stage_.motion();
  Line line;
  line.text("status state=").text(stage_.state()).field("x", m.x()).field("y", m.y());
  line.field("points", m.points()).field("pulses", m.pulses());
  line.field("alarm", stage_.alarm()).field("limits", hal_inputs()).field("homed", stage_.homed());
  send(line);
}
