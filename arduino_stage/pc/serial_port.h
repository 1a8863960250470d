// The far end of the USB cable: a pseudo terminal with a fixed name, and who has opened it.
#pragma once
#include <string>

class SerialPort {
 public:
  // Makes the symbolic link `link`; throws nothing, see error().
  explicit SerialPort(const std::string& link);
  ~SerialPort();

  const std::string& error() const { return error_; }
  int fd() const { return master_; }
  int watch_fd() const { return watch_; }  // readable when a client opens or closes the port

  // Take note of opening and closing. True when DTR rose, which resets an UNO, however shortly it had been low.
  bool opened();
  // Whether a client held the port open when opened() was last called.
  bool is_open() const { return clients_ > 0; }
  // Up to `size` received bytes; 0 when there are none.
  int read(unsigned char* bytes, int size);
  // What a client does not read in time is lost, as on a serial line.
  void write(const std::string& bytes);
  // Forget what was received, and take the bytes as they are from now on.
  void flush();

 private:
  std::string link_, error_;
  int master_ = -1, watch_ = -1, clients_ = 0;
  bool dtr_ = false;

  void closed();
};
