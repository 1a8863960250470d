/* The ATmega328P: libsimavr 1.6, and what it does differently from the chip. */
#include "unosim.h"

#include <string.h>
#include <simavr/avr_extint.h>
#include <simavr/avr_timer.h>
#include <simavr/sim_hex.h>
#include <simavr/sim_time.h>

#define N_VECTORS 26

static struct { uint64_t entered, count, most; } vectors[N_VECTORS];

/* simavr charges nothing for interrupt entry; the data sheet says four cycles. */
static void interrupt_runs(avr_irq_t *irq, uint32_t running, void *param) {
  const int i = (int)(intptr_t)param;
  (void)irq;
  if (running) {
    vectors[i].entered = avr->cycle;
    avr->cycle += 4;
  } else {
    const uint64_t took = avr->cycle + 4 - vectors[i].entered; /* reti itself takes four, charged after this call */
    vectors[i].count++;
    if (took > vectors[i].most) vectors[i].most = took;
  }
}

/* Any write to TIFRn clears all its flags; on the chip it clears the written ones. */
static void tifr_write(avr_t *a, avr_io_addr_t addr, uint8_t value, void *param) {
  avr_timer_t *t = param;
  avr_int_vector_t *flags[] = { &t->overflow, &t->icr, &t->comp[0].interrupt, &t->comp[1].interrupt, &t->comp[2].interrupt };
  for (int i = 0; i < 5; i++)
    if (flags[i]->raised.reg == addr && value >> flags[i]->raised.bit & 1) avr_clear_interrupt(a, flags[i]);
}

/* A hanging program is a jump to itself, until a reset, also by the watchdog. simavr restarts its cycle count then. */
#define JUMP_TO_ITSELF 0xcfff
static int hangs, by_watchdog;
static avr_flashaddr_t hangs_at;
static uint16_t jumped_over;
static uint64_t reset_at;

static void put_word(avr_flashaddr_t at, uint16_t word) {
  avr->flash[at] = word & 0xff;
  avr->flash[at + 1] = word >> 8;
}

static void on_reset(avr_t *a) {
  by_watchdog = 1; /* unless reset() says otherwise */
  reset_at = a->cycle;
}

static void correct_simavr(void) {
  for (avr_io_t *io = avr->io_port; io; io = io->next) {
    if (strcmp(io->kind, "timer")) continue;
    avr_timer_t *t = (avr_timer_t *)io;
    const int a = AVR_DATA_TO_IO(t->overflow.raised.reg);
    avr->io[a].w.c = tifr_write;
    avr->io[a].w.param = t;
  }
  for (intptr_t i = 1; i < N_VECTORS; i++) {
    avr_irq_t *q = avr_get_interrupt_irq(avr, i);
    if (q) avr_irq_register_notify(q + AVR_INT_IRQ_RUNNING, interrupt_runs, (void *)i);
  }
}

static void after_reset(void) {
  /* Pins 2 and 3 default to level interrupts, which simavr polls every cycle while low: ten times slower. */
  avr_extint_set_strict_lvl_trig(avr, 0, 0);
  avr_extint_set_strict_lvl_trig(avr, 1, 0);
  avr->run_cycle_limit = HZ / 4000; /* avr_reset() sets 1: return after every instruction */
}

static void log_errors(avr_t *a, const int level, const char *format, va_list values) { /* its own way is standard output */
  (void)a;
  if (level <= LOG_ERROR) vfprintf(stderr, format, values);
}

int chip_begin(const char *hex) {
  uint32_t size, base;
  avr_global_logger_set(log_errors);
  uint8_t *code = read_ihex_file(hex, &size, &base);
  avr = avr_make_mcu_by_name("atmega328p");
  if (!code || !avr) return -1;
  avr_init(avr);
  avr->log = LOG_ERROR;
  avr->frequency = HZ;
  avr_loadcode(avr, code, size, base);
  avr->codeend = avr->flashend;
  avr->reset = on_reset;
  correct_simavr();
  after_reset();
  return 0;
}

static void begin_anew(uint64_t now, const char *why) {
  avr->cycle = now;
  by_watchdog = 0;
  serial_reset();
  if (hangs) put_word(hangs_at, jumped_over);
  hangs = 0;
  after_reset();
  rig_reset();
  say("X %llu %s\n", (u64)now, why);
}

void reset(void) {
  const avr_cycle_count_t now = avr->cycle;
  avr_reset(avr);
  memset(avr->data + 32, 0, 0x100 - 32); /* the io space: pins are let go */
  avr_reset(avr);
  begin_anew(now, "reset");
}

int hang(void) {
  while (!hangs && run_to(avr->cycle + 1)) {
    if (!avr->sreg[S_I] || avr->interrupts.running_ptr) continue; /* in an interrupt, or under a lock */
    hangs_at = avr->pc;
    jumped_over = avr->flash[hangs_at] | avr->flash[hangs_at + 1] << 8;
    put_word(hangs_at, JUMP_TO_ITSELF);
    hangs = 1;
  }
  return hangs;
}

static avr_cycle_count_t stop_here(avr_t *a, avr_cycle_count_t when, void *param) {
  (void)a, (void)when, (void)param;
  return 0; /* a cycle timer makes the core return exactly there */
}

int run_to(uint64_t end) {
  if (avr->cycle >= end) return 1;
  avr_cycle_timer_register(avr, end - avr->cycle, stop_here, 0);
  while (avr->cycle < end && !ended) {
    const int state = avr_run(avr);
    if (by_watchdog) {
      begin_anew(reset_at, "watchdog");
      if (avr->cycle < end) avr_cycle_timer_register(avr, end - avr->cycle, stop_here, 0);
    }
    if (state == cpu_Done || state == cpu_Crashed) {
      say("X %llu crash\n", (u64)avr->cycle);
      return 0;
    }
  }
  return !ended;
}

void tell_interrupt_costs(void) {
  for (int i = 0; i < N_VECTORS; i++) {
    if (vectors[i].count) say("C %d %llu %llu\n", i, (u64)vectors[i].count, (u64)vectors[i].most);
    vectors[i].count = vectors[i].most = 0; /* one may be under way: its entry stays */
  }
}
