// The far end of the USB cable: a pseudo terminal with a fixed name that detects clients.
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

  // Update after opening and closing. True if DTR rose, even after a very short low: that resets an UNO.
  bool opened();
  // True if a client held the port open at the last call of opened().
  bool is_open() const { return clients_ > 0; }
  // Up to `size` received bytes; 0 when there are none.
  int read(unsigned char* bytes, int size);
  // Send bytes; those that a client does not read in time are lost, as on a serial line.
  void write(const std::string& bytes);
  // Drop received bytes and set the terminal to raw mode.
  void flush();

 private:
  std::string link_, error_;
  int master_ = -1, watch_ = -1, clients_ = 0;
  bool dtr_ = false;

  void closed();
};
