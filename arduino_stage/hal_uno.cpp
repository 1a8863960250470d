#ifdef __AVR__
#include "hal_uno.h"

#include <Arduino.h>
#include <avr/interrupt.h>
#include <avr/wdt.h>

#include "motion_step.h"

// The Arduino core's Serial is not used: its receive interrupt has no immediate bytes, and drops bytes silently.

Motion motion;  // here, so that the interrupt is compiled with its address
Stage stage(motion);

namespace {

uint16_t trigger_ticks;   // width of a trigger pulse
uint8_t inverted;         // bits of Pin
uint8_t inverted_inputs;  // the same for pressed(): bits of Input
uint16_t due;  // of the next step, in ticks of timer 1
static_assert(board::PIN_X_PUL < 8 && board::PIN_LEFT_PUL < 8 && board::PIN_RIGHT_PUL < 8, "PUL pins are on port D");
constexpr uint16_t PULSE_TICKS = board::TICK_HZ / 1000000 * board::STEP_PULSE_US;  // width of a step pulse

// Byte queue between an interrupt and the main program: one side puts, the other takes.
class Ring {
 public:
  uint8_t room() const { return (uint8_t)(tail_ - head_ - 1) & (SIZE - 1); }
  bool empty() const { return head_ == tail_; }
  bool put(uint8_t byte) {
    const uint8_t next = (head_ + 1) & (SIZE - 1);
    if (next == tail_) return false;
    bytes_[head_] = byte;
    head_ = next;
    return true;
  }
  uint8_t take() {
    const uint8_t byte = bytes_[tail_];
    tail_ = (tail_ + 1) & (SIZE - 1);
    return byte;
  }

 private:
  static constexpr uint8_t SIZE = 128;  // a power of two, longer than the longest line
  volatile uint8_t bytes_[SIZE];
  volatile uint8_t head_ = 0, tail_ = 0;
};

Ring received, to_send;
volatile bool overflowed;  // received bytes were lost because the ring was full

// Direct port access: digitalWrite takes 4 us a pin. On the UNO, D0..D7 are port D, D8..D13 B, A0..A5 (14..19) C.
template <uint8_t PIN>
inline void write(bool high) {
  volatile uint8_t& port = PIN < 8 ? PORTD : PIN < 14 ? PORTB : PORTC;
  constexpr uint8_t mask = 1 << (PIN < 8 ? PIN : PIN < 14 ? PIN - 8 : PIN - 14);
  if (high) {
    port |= mask;
  } else {
    port &= (uint8_t)~mask;
  }
}

template <uint8_t PIN>
inline bool read() {
  const uint8_t port = PIN < 8 ? PIND : PIN < 14 ? PINB : PINC;
  return port & 1 << (PIN < 8 ? PIN : PIN < 14 ? PIN - 8 : PIN - 14);
}

inline uint8_t pressed() {
  uint8_t inputs = 0;
  if (board::HAS_SWITCHES) {
    if (read<board::PIN_X_SWITCH>()) inputs |= SWITCH_X;
    if (read<board::PIN_Y_SWITCH>()) inputs |= SWITCH_Y;
  }
  if (board::HAS_EMERGENCY_STOP && read<board::PIN_EMERGENCY>()) inputs |= EMERGENCY;
  return inputs ^ inverted_inputs;
}

}  // namespace

InterruptLock::InterruptLock() : saved_(SREG) { cli(); }
InterruptLock::~InterruptLock() { SREG = saved_; }

void uno_begin() {
  hal_trigger_width(board::DEFAULT_TRIGGER_US);
  hal_enable(false);
  const uint8_t outputs[] = {board::PIN_TRIGGER,   board::PIN_LEFT_PUL, board::PIN_LEFT_DIR, board::PIN_RIGHT_PUL,
                             board::PIN_RIGHT_DIR, board::PIN_X_PUL,    board::PIN_X_DIR,    board::PIN_ENABLE,
                             board::PIN_BRAKE};
  for (uint8_t pin : outputs) pinMode(pin, OUTPUT);
  const uint8_t inputs[] = {board::PIN_X_SWITCH, board::PIN_Y_SWITCH, board::PIN_EMERGENCY};
  for (uint8_t pin : inputs) pinMode(pin, INPUT_PULLUP);

  InterruptLock lock;
  TCCR1A = 0;
  TCCR1B = _BV(CS11);  // free running at 16 MHz / 8 = TICK_HZ
  TIMSK1 = 0;
  UCSR0A = _BV(U2X0);
  UBRR0 = (uint16_t)((F_CPU / 4 / board::BAUD - 1) / 2);
  UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);  // 8 data bits, no parity, one stop bit
  UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
  MCUSR = 0;
  wdt_enable(WDTO_250MS);
}

void uno_alive() { wdt_reset(); }

bool uno_read(uint8_t& byte) {
  if (received.empty()) return false;
  byte = received.take();
  return true;
}

bool uno_lost() {
  const bool lost = overflowed;
  if (lost) overflowed = false;
  return lost;
}

// A byte has come. A damaged one becomes 0, which is in no line, so that its line is refused.
ISR(USART_RX_vect) {
  const bool damaged = UCSR0A & (_BV(FE0) | _BV(DOR0));
  const uint8_t byte = UDR0;
  if (stage.immediate(damaged ? 0 : byte)) return;
  if (!received.put(damaged ? 0 : byte)) overflowed = true;
}

// The transmitter takes the next byte.
ISR(USART_UDRE_vect) {
  if (to_send.empty()) {
    UCSR0B &= (uint8_t)~_BV(UDRIE0);
  } else {
    UDR0 = to_send.take();
  }
}

// A step is due: step the motors, start the trigger pulse, set the time of the next step.
// Measured worst case: 755 cycles from entry to reti (a ramp step of both axes; avr-gcc 5.4, emulated UNO), of the 800
// between two steps at MAX_RATE. Steps that other interrupts delay are caught up.
ISR(TIMER1_COMPA_vect) {
  const uint8_t out = motion.step(pressed());
  uint8_t pulses = 0;
  if (out & STEP_X) pulses |= 1 << board::PIN_X_PUL;
  if (out & STEP_Y) pulses |= 1 << board::PIN_LEFT_PUL | 1 << board::PIN_RIGHT_PUL;
  PIND = pulses;  // toggles the pins, whichever level they rest at
  if ((out & TRIGGER) && !read<board::PIN_TRIGGER>()) {
    write<board::PIN_TRIGGER>(true);
    OCR1B = TCNT1 + trigger_ticks;
    TIFR1 = _BV(OCF1B);
    TIMSK1 |= _BV(OCIE1B);
    motion.count_pulse();
  }
  const uint16_t risen = TCNT1;
  const uint16_t ticks = motion.interval();
  if (ticks) {
    // Relative to the step's due time, so that delays do not add up. A step that is overdue comes at once.
    const uint16_t since = TCNT1 - due;
    due += ticks;
    OCR1A = since < ticks - 3 ? due : TCNT1 + 3;
  } else {
    TIMSK1 &= (uint8_t)~_BV(OCIE1A);
  }
  while ((uint16_t)(TCNT1 - risen) < PULSE_TICKS) {
  }
  PIND = pulses;
}

// The end of the trigger pulse.
ISR(TIMER1_COMPB_vect) {
  write<board::PIN_TRIGGER>(false);
  TIMSK1 &= (uint8_t)~_BV(OCIE1B);
}

uint8_t hal_inputs() { return pressed(); }

void hal_start_steps(uint16_t ticks) {
  InterruptLock lock;
  OCR1A = due = TCNT1 + ticks;
  TIFR1 = _BV(OCF1A);
  TIMSK1 |= _BV(OCIE1A);
}

void hal_directions(bool x_positive, bool y_positive) {
  write<board::PIN_X_DIR>((x_positive == board::X_POSITIVE_HIGH) != !!(inverted & PIN_BIT_X_DIR));
  write<board::PIN_LEFT_DIR>((y_positive == board::LEFT_POSITIVE_HIGH) != !!(inverted & PIN_BIT_LEFT_DIR));
  write<board::PIN_RIGHT_DIR>((y_positive == board::RIGHT_POSITIVE_HIGH) != !!(inverted & PIN_BIT_RIGHT_DIR));
}

void hal_enable(bool on) {
  write<board::PIN_ENABLE>(on == !!(inverted & PIN_BIT_ENABLE));
  write<board::PIN_BRAKE>(on);
}

void hal_pins(uint8_t bits) {
  InterruptLock lock;
  inverted = bits;
  inverted_inputs = 0;
  if (board::HAS_SWITCHES && bits & PIN_BIT_SWITCHES) inverted_inputs |= SWITCHES;
  if (board::HAS_EMERGENCY_STOP && bits & PIN_BIT_EMERGENCY) inverted_inputs |= EMERGENCY;
  const bool rest = bits & PIN_BIT_PUL;
  write<board::PIN_X_PUL>(rest);
  write<board::PIN_LEFT_PUL>(rest);
  write<board::PIN_RIGHT_PUL>(rest);
}

void hal_trigger_width(uint16_t us) {
  InterruptLock lock;
  trigger_ticks = us < 4 ? 8 : us * 2;  // at least 4 us: a shorter time might pass before the flag is cleared
}

uint8_t hal_room() { return to_send.room(); }

void hal_write(const char* text, uint8_t length) {
  while (length--) {
    while (!to_send.put((uint8_t)*text)) {
    }
    text++;
    InterruptLock lock;
    UCSR0B |= _BV(UDRIE0);
  }
}

uint16_t hal_steps_per_mm() { return board::STEPS_PER_MM; }
#endif
