#include "serial_port.h"

#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/inotify.h>
#include <termios.h>
#include <unistd.h>

SerialPort::SerialPort(const std::string& link) : link_(link) {
  master_ = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
  char name[128];
  if (master_ < 0 || grantpt(master_) || unlockpt(master_) || ptsname_r(master_, name, sizeof name)) {
    error_ = std::string("no pseudo terminal: ") + strerror(errno);
    return;
  }
  termios t;
  if (tcgetattr(master_, &t) == 0) {
    t.c_cflag |= HUPCL;  // as a serial port has, and a pseudo terminal not
    tcsetattr(master_, TCSANOW, &t);
  }
  flush();
  watch_ = inotify_init1(IN_NONBLOCK | IN_CLOEXEC);
  if (inotify_add_watch(watch_, name, IN_OPEN | IN_CLOSE) < 0) {
    error_ = std::string("no watch on the pseudo terminal: ") + strerror(errno);
    return;
  }
  const std::string fresh = link + ".new";
  unlink(fresh.c_str());
  if (symlink(name, fresh.c_str()) || rename(fresh.c_str(), link.c_str())) {
    error_ = link + ": " + strerror(errno);
    link_.clear();
  }
}

SerialPort::~SerialPort() {
  if (!link_.empty()) unlink(link_.c_str());
  if (watch_ >= 0) close(watch_);
  if (master_ >= 0) close(master_);
}

// The kernel raises DTR when a serial port is opened, and lowers it at the last close unless HUPCL was taken away.
void SerialPort::closed() {
  termios t;
  if (--clients_ == 0 && tcgetattr(master_, &t) == 0 && (t.c_cflag & HUPCL)) dtr_ = false;
}

bool SerialPort::opened() {
  alignas(inotify_event) char events[4096];
  bool rose = false;
  for (ssize_t n; (n = ::read(watch_, events, sizeof events)) > 0;) {
    for (char* p = events; p < events + n;) {
      const inotify_event* event = (const inotify_event*)p;
      if (event->mask & IN_OPEN) {
        rose |= !dtr_;
        dtr_ = true;
        clients_++;
      }
      if (event->mask & IN_CLOSE) closed();
      p += sizeof(inotify_event) + event->len;
    }
  }
  return rose;
}

int SerialPort::read(unsigned char* bytes, int size) {
  const ssize_t n = ::read(master_, bytes, (size_t)size);
  return n > 0 ? (int)n : 0;
}

void SerialPort::write(const std::string& bytes) {
  const ssize_t n = ::write(master_, bytes.data(), bytes.size());
  (void)n;
}

void SerialPort::flush() {
  termios t;
  if (tcgetattr(master_, &t) == 0) {
    cfmakeraw(&t);
    tcsetattr(master_, TCSANOW, &t);
  }
  unsigned char bytes[512];
  while (read(bytes, sizeof bytes) > 0) {
  }
}
