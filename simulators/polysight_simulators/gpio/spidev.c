/* A stand-in for spidev (<linux/spi/spidev.h>): the bits of a transfer become edges of MOSI on the simulated wires.
 *
 *   GPIOSHIM_SPI=PATH      the device; made here, a link to /dev/null
 *   GPIOSHIM_MOSI=LINE     10 where nothing is said
 *   GPIOSHIM_MISO=0        the return wire from MOSI to MISO is off; it is there where nothing is said
 *   GPIOSHIM_BUFSIZ=BYTES  of spidev's buffer, 4096 where nothing is said
 *   GPIOSHIM_CORE_HZ=A,B   the core clock as the driver believes it to be, and as it is; 250 MHz
 *   GPIOSHIM_EXACT=1       a thread lives in wire time from its first transfer on, in which each takes exactly its duration
 *
 * From Linux: what spidev refuses (drivers/spi/spidev.c), the even divisor of the core clock that is never faster than
 * asked for (spi-bcm2835.c). The most significant bit goes first, MOSI stays as the last bit left it, and a transfer that
 * has begun goes to its end, also when the program dies. A transfer starts at once and its bytes have no gaps between
 * them: a Pi's controller may do otherwise. */
#include "gpioshim.h"
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <linux/spi/spi.h>
#include <linux/spi/spidev.h>

#define MODES (SPI_CPOL | SPI_CPHA | SPI_CS_HIGH | SPI_NO_CS | SPI_3WIRE) /* of spi-bcm2835.c */
#define MOST_HZ 125000000.0 /* the core clock by the least divisor, 2 */

/* The settings above; `returned` is the wire from MOSI to MISO. */
static unsigned mosi = 10, bufsiz = 4096;
static int returned = 1;
static double believed_hz = 250e6, core_hz = 250e6;
static int exact;

void read_spi_settings(void) {
  const char *line = getenv("GPIOSHIM_MOSI"), *bytes = getenv("GPIOSHIM_BUFSIZ"), *clock = getenv("GPIOSHIM_CORE_HZ");
  const char *miso = getenv("GPIOSHIM_MISO");
  if (line) mosi = atoi(line);
  if (miso) returned = atoi(miso);
  if (bytes) bufsiz = atoi(bytes);
  if (clock) sscanf(clock, "%lf,%lf", &believed_hz, &core_hz);
  exact = getenv("GPIOSHIM_EXACT") != 0;
}

static double bit_ns(uint32_t asked_hz) { /* duration of a bit; 0 asks for the fastest */
  const double wanted_hz = asked_hz && asked_hz < MOST_HZ ? asked_hz : MOST_HZ;
  unsigned divisor = believed_hz / wanted_hz;
  if (divisor * wanted_hz < believed_hz) divisor++;
  divisor += divisor % 2;
  if (divisor == 0 || divisor >= 65536) divisor = 65536;
  return 1e9 * divisor / core_hz;
}

static int transfer(const struct spi_ioc_transfer *t, unsigned n) {
  uint64_t bytes = 0;
  for (unsigned i = 0; i < n; i++) {
    bytes += t[i].len;
    if (t[i].bits_per_word != 0 && t[i].bits_per_word != 8) return -EINVAL;
    if (bytes > bufsiz) return -EMSGSIZE;
  }
  if (exact && !thread_ns) thread_ns = now_ns(CLOCK_MONOTONIC);
  for (unsigned i = 0; i < n; i++) {
    const uint8_t *sent = (const uint8_t *)(uintptr_t)t[i].tx_buf;
    const double bit = bit_ns(t[i].speed_hz);
    if (t[i].rx_buf && sent && returned) memcpy((void *)(uintptr_t)t[i].rx_buf, sent, t[i].len);
    if (t[i].rx_buf && !(sent && returned)) memset((void *)(uintptr_t)t[i].rx_buf, 0, t[i].len);
    const uint64_t begin = now_ns(CLOCK_MONOTONIC);
    for (uint64_t k = 0; k < 8ULL * t[i].len; k++)
      set_output_at(mosi, sent && sent[k / 8] >> (7 - k % 8) & 1, begin + (uint64_t)(k * bit + 0.5));
    sleep_until(begin + (uint64_t)(8 * t[i].len * bit + 0.5));
  }
  return (int)bytes;
}

int ask_spi(unsigned long what, void *arg) {
  static const struct spi_ioc_transfer one;
  if (what == SPI_IOC_WR_MODE) return *(uint8_t *)arg & ~MODES ? -EINVAL : 0;
  if (_IOC_TYPE(what) != SPI_IOC_MAGIC || _IOC_NR(what) != 0 || _IOC_DIR(what) != _IOC_WRITE) return -ENOTTY;
  if (_IOC_SIZE(what) == 0 || _IOC_SIZE(what) % sizeof one) return -EINVAL;
  return transfer(arg, _IOC_SIZE(what) / sizeof one);
}

int shown_bufsiz(char *text, int size) { return snprintf(text, size, "%u\n", bufsiz); }
