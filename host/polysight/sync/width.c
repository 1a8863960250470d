/* Width in bits of the widest vectors of this processor that the other files were compiled for. */
#if defined(__x86_64__)
#include <cpuid.h>

/* By cpuid, for __builtin_cpu_supports is wrong in programs linked by zig. */
int vector_bits(void)
{
    /* Bits of cpuid: FMA and OSXSAVE in ecx of leaf 1; AVX2, and AVX-512 F, DQ, BW, VL in ebx of leaf 7. Of xgetbv: 0x6 if
       the system saves vectors of 256 bits, 0xe6 if also those of 512. */
    const unsigned fma_and_saved = 1u << 12 | 1u << 27, avx2 = 1u << 5, avx512 = 1u << 16 | 1u << 17 | 1u << 30 | 1u << 31;
    unsigned a, b, c, d, saved, high;
    if (!__get_cpuid(1, &a, &b, &c, &d) || (c & fma_and_saved) != fma_and_saved)
        return 128;
    __asm__("xgetbv" : "=a"(saved), "=d"(high) : "c"(0)); /* registers saved by the operating system */
    if (!__get_cpuid_count(7, 0, &a, &b, &c, &d) || (saved & 0x6) != 0x6 || !(b & avx2))
        return 128;
    return (saved & 0xe6) == 0xe6 && (b & avx512) == avx512 ? 512 : 256;
}
#else
int vector_bits(void) { return 128; }
#endif
