/* The serial line: frames at its own pace, and a pseudo terminal at its end. */
#include "unosim.h"

#include <fcntl.h>
#include <poll.h>
#include <pty.h>
#include <string.h>
#include <sys/inotify.h>
#include <termios.h>
#include <unistd.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_time.h>

DEFINE_FIFO(uint16_t, uart_fifo);

int pty = -1;
uint64_t pty_bytes, pty_sent;
static avr_uart_t *uart;
static int pty_watch = -1, pty_clients, dtr; /* pty_watch: inotify, which tells who opens and closes the terminal */
static uint64_t line_busy;                   /* the end of the last byte, either way */
/* Bytes on their way, and how many went in and out of each queue. */
static uint8_t to_board[1 << 16];
static unsigned to_head, to_tail;
static struct { uint64_t when; uint8_t byte; } from_board[4096];
static unsigned from_head, from_tail;

static uint64_t frame(void) { /* cycles of a byte: 10 bits by 8N1; simavr 1.6 counts 11 */
  const unsigned ubrr = avr->data[uart->r_udr - 2] | (avr->data[uart->r_udr - 1] & 15) << 8;
  return 10ULL * (ubrr + 1) * (avr->data[uart->r_ucsra] & 2 ? 8 : 16);
}

static avr_cycle_count_t byte_sent(avr_t *a, avr_cycle_count_t when, void *param) {
  (void)a, (void)param;
  const uint8_t byte = from_board[from_tail++ & 4095].byte;
  line_busy = when;
  if (pty < 0) say("T %llu %02x\n", (u64)when, byte);
  else if (write(pty, &byte, 1) == 1) pty_sent++; /* what nobody reads is lost, as on a wire */
  return from_head != from_tail ? from_board[from_tail & 4095].when : 0;
}

static void uart_out(avr_irq_t *irq, uint32_t value, void *param) {
  (void)irq, (void)param;
  const uint64_t f = frame();
  uart->cycles_per_byte = f;
  const uint64_t idle_from = from_head != from_tail ? from_board[(from_head - 1) & 4095].when : 0;
  const uint64_t start = idle_from > avr->cycle ? idle_from : avr->cycle;
  const int idle = from_head == from_tail;
  from_board[from_head & 4095].when = start + f;
  from_board[from_head++ & 4095].byte = value;
  if (idle) avr_cycle_timer_register(avr, start + f - avr->cycle, byte_sent, 0);
}

static avr_cycle_count_t byte_received(avr_t *a, avr_cycle_count_t when, void *param) {
  (void)a, (void)param;
  const uint8_t byte = to_board[to_tail++ % sizeof to_board];
  const uint64_t f = frame();
  line_busy = when;
  if (uart_fifo_get_read_size(&uart->input) >= 2) { /* the real USART has two bytes, simavr's 64 */
    say("X %llu overrun\n", (u64)avr->cycle);
  } else {
    uart->cycles_per_byte = 1; /* raise RXC now: the pacing is ours */
    avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT), byte);
    uart->cycles_per_byte = f;
  }
  return to_head != to_tail ? when + f : 0;
}

void serial_begin(void) {
  uint32_t flags = 0; /* no echo on standard output, no sleeping while polled */
  for (avr_io_t *io = avr->io_port; io; io = io->next) if (!strcmp(io->kind, "uart")) uart = (avr_uart_t *)io;
  avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
  avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), uart_out, 0);
}

void serial_reset(void) {
  to_head = to_tail = from_head = from_tail = 0;
  avr_cycle_timer_cancel(avr, byte_received, 0);
  avr_cycle_timer_cancel(avr, byte_sent, 0);
}

void feed(uint8_t byte) {
  const int idle = to_head == to_tail && !avr_cycle_timer_status(avr, byte_received, 0);
  to_board[to_head++ % sizeof to_board] = byte;
  if (idle) avr_cycle_timer_register(avr, frame(), byte_received, 0);
}

int line_idle(void) { return to_head == to_tail && from_head == from_tail; }

uint64_t line_idle_since(void) { return line_busy; }

uint64_t line_backlog(void) { return (to_head - to_tail) * frame(); }

int make_pty(const char *link) {
  int far;
  char name[64], fresh[4096];
  struct termios t;
  if (openpty(&pty, &far, name, 0, 0)) return -1;
  tcgetattr(far, &t);
  cfmakeraw(&t);
  t.c_cflag |= HUPCL; /* as a serial port has, and a pseudo terminal not */
  tcsetattr(far, TCSANOW, &t);
  close(far);
  fcntl(pty, F_SETFL, O_NONBLOCK);
  pty_watch = inotify_init1(IN_NONBLOCK | IN_CLOEXEC);
  if (inotify_add_watch(pty_watch, name, IN_OPEN | IN_CLOSE) < 0) return -1;
  snprintf(fresh, sizeof fresh, "%s.new", link);
  unlink(fresh);
  return symlink(name, fresh) || rename(fresh, link) ? -1 : 0;
}

/* The kernel raises DTR when a serial port is opened, and lowers it at the last close unless HUPCL was taken away. */
static void closed(void) {
  struct termios t;
  if (--pty_clients == 0 && !tcgetattr(pty, &t) && t.c_cflag & HUPCL) dtr = 0;
}

int pty_opened(void) {
  char events[4096] __attribute__((aligned(8)));
  int rose = 0;
  for (ssize_t n; (n = read(pty_watch, events, sizeof events)) > 0;)
    for (char *e = events; e < events + n; e += sizeof(struct inotify_event) + ((struct inotify_event *)e)->len) {
      const uint32_t what = ((struct inotify_event *)e)->mask;
      if (what & IN_OPEN) {
        rose |= !dtr;
        dtr = 1;
        pty_clients++;
      }
      if (what & IN_CLOSE) closed();
    }
  return rose;
}

void read_pty(int wait_ms) {
  struct pollfd p = { pty, POLLIN, 0 };
  uint8_t bytes[512];
  if (lockstep || pty_clients) poll(&p, 1, wait_ms);
  if (!(p.revents & POLLIN) || to_head - to_tail > sizeof to_board / 2) return;
  const ssize_t n = read(pty, bytes, sizeof bytes);
  for (ssize_t i = 0; i < n; i++) feed(bytes[i]);
  if (n > 0) pty_bytes += n;
}
