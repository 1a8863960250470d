/* Calls a loop of synchronisation, for `arm64.py`: NAME on the command line, its arguments on the standard input, each
   as a size in bytes and an array, or as size -1 and a number. Arrays go to the standard output as the call left them. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define MOST 24 /* arguments; numbers and pointers both take a register or eight bytes of stack on ARM64 */
typedef int Loop(long, long, long, long, long, long, long, long, long, long, long, long, long, long, long, long, long,
                 long, long, long, long, long, long, long);
extern Loop align_128, find_128, remove_128;

int main(int count, char **words)
{
    Loop *loops[] = {align_128, find_128, remove_128};
    const char *names[] = {"align", "find", "remove"};
    long a[MOST] = {0};
    int64_t sizes[MOST], size;
    int given = 0, status = 1;
    while (given < MOST && fread(&size, sizeof size, 1, stdin) == 1) {
        int64_t number;
        void *here = size < 0 ? (void *)&number : malloc(size + 1);
        size_t bytes = size < 0 ? sizeof number : (size_t)size;
        if (fread(here, 1, bytes, stdin) != bytes)
            return 2;
        sizes[given] = size;
        a[given++] = size < 0 ? (long)number : (long)here;
    }
    for (int i = 0; i < 3 && count == 2; i++)
        if (!strcmp(words[1], names[i]))
            status = loops[i](a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7], a[8], a[9], a[10], a[11], a[12], a[13],
                              a[14], a[15], a[16], a[17], a[18], a[19], a[20], a[21], a[22], a[23]);
    for (int i = 0; i < given; i++)
        if (sizes[i] > 0)
            fwrite((void *)a[i], 1, sizes[i], stdout);
    return status;
}
