# Firmware for the Arduino UNO without arduino-cli: Debian's gcc-avr, avr-libc and arduino-core-avr.
# Flags are those of /usr/share/arduino/hardware/arduino/avr/{platform,boards}.txt.
# Another compiler: AVR=/folder/of/its/programs/avr-
ARD     ?= /usr/share/arduino/hardware/arduino/avr
AVR     ?= avr-
AVRDUDE ?= avrdude
AVR_B    = build/uno
CORE     = $(ARD)/cores/arduino
AVR_DEFS = -mmcu=atmega328p -DF_CPU=16000000L -DARDUINO=10819 -DARDUINO_AVR_UNO -DARDUINO_ARCH_AVR
AVR_INC  = -I. -I$(CORE) -I$(ARD)/variants/standard
AVR_OPT  = -g -Os -ffunction-sections -fdata-sections -MMD -flto
AVR_C    = $(AVR_OPT) -w -std=gnu11 -fno-fat-lto-objects
AVR_CXX  = $(AVR_OPT) -std=gnu++11 -fpermissive -fno-exceptions -fno-threadsafe-statics -Wno-error=narrowing \
           -DDECIMAL_DIG=__DECIMAL_DIG__   # gcc 5.4's float.h hides it from C++, and WString.cpp 1.8.7 wants it
AVR_LD   = -w -Os -g -flto -fuse-linker-plugin -Wl,--gc-sections -mmcu=atmega328p
CORE_OBJ = $(patsubst $(CORE)/%,$(AVR_B)/core/%.o,$(wildcard $(CORE)/*.c $(CORE)/*.cpp $(CORE)/*.S))
OWN_OBJ  = $(AVR_B)/arduino_stage.ino.o $(patsubst %.cpp,$(AVR_B)/%.cpp.o,$(wildcard *.cpp))

firmware: $(AVR_B)/arduino_stage.hex
	$(AVR)size --format=avr --mcu=atmega328p $(AVR_B)/arduino_stage.elf
flash: $(AVR_B)/arduino_stage.hex
	@test -n "$(PORT)" || { echo "which port? make flash PORT=/dev/ttyACM0"; exit 2; }
	@command -v $(AVRDUDE) >/dev/null || { echo "no avrdude: sudo apt-get install avrdude"; exit 2; }
	$(AVRDUDE) -p atmega328p -c arduino -P $(PORT) -b 115200 -D -U flash:w:$<:i
$(AVR_B)/core/%.c.o: $(CORE)/%.c | $(AVR_B)/core
	$(AVR)gcc -c $(AVR_C) $(AVR_DEFS) $(AVR_INC) $< -o $@
$(AVR_B)/core/%.cpp.o: $(CORE)/%.cpp | $(AVR_B)/core
	$(AVR)g++ -c -w $(AVR_CXX) $(AVR_DEFS) $(AVR_INC) $< -o $@
$(AVR_B)/core/%.S.o: $(CORE)/%.S | $(AVR_B)/core
	$(AVR)gcc -c -g -x assembler-with-cpp -flto -MMD $(AVR_DEFS) $(AVR_INC) $< -o $@
$(AVR_B)/core.a: $(CORE_OBJ)
	rm -f $@; $(AVR)gcc-ar rcs $@ $^
$(AVR_B)/%.cpp.o: %.cpp $(wildcard *.h) | $(AVR_B)/core
	$(AVR)g++ -c $(AVR_CXX) -Wall -Wextra -Werror $(AVR_DEFS) $(AVR_INC) $< -o $@
$(AVR_B)/%.ino.o: %.ino $(wildcard *.h) | $(AVR_B)/core
	$(AVR)g++ -c -x c++ -include Arduino.h $(AVR_CXX) -Wall -Wextra -Werror $(AVR_DEFS) $(AVR_INC) $< -o $@
$(AVR_B)/arduino_stage.elf: $(OWN_OBJ) $(AVR_B)/core.a
	$(AVR)gcc $(AVR_LD) -o $@ $^ -lm
%.hex: %.elf
	$(AVR)objcopy -O ihex -R .eeprom $< $@
$(AVR_B)/core:
	mkdir -p $@
.PHONY: firmware flash
