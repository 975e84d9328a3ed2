// Does this compiler's code for AMX work? Loads a tile configuration as llama.cpp does and stores it back.
// Exit code 0: all 64 bytes arrived. Compiled with -O2 -mamx-tile; with -DNOTHING it only says which flags are known.

#ifdef NOTHING
int main() {}
#else
#include <immintrin.h>
#include <sys/syscall.h>
#include <unistd.h>

constexpr int ARCH_REQ_XCOMP_PERM = 0x1023, XFEATURE_XTILEDATA = 18;  // Linux: asm/prctl.h, Documentation/arch/x86/xstate.rst

struct Tiles {
    unsigned char palette, start_row, unused[14];
    unsigned short row_bytes[16];
    unsigned char rows[16];
};

// On its own, so that only the intrinsic reads the configuration
__attribute__((noinline)) static void configure() {
    alignas(64) Tiles tiles = {};
    tiles.palette = 1;
    for (int i = 0; i < 8; ++i) {
        tiles.row_bytes[i] = 64;
        tiles.rows[i] = 16;
    }
    _tile_loadconfig(&tiles);
}

static unsigned char wanted(int place) {
    if (place == 0) return 1;
    if (place >= 16 && place < 32) return place % 2 == 0 ? 64 : 0;
    return place >= 48 && place < 56 ? 16 : 0;
}

int main() {
    if (syscall(SYS_arch_prctl, ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA)) return 2;
    alignas(64) volatile unsigned char seen[64];  // volatile: the same bug lets the store promise 8 bytes
    for (int i = 0; i < 64; ++i) seen[i] = 0xff;
    configure();
    _tile_storeconfig(const_cast<unsigned char *>(seen));
    for (int i = 0; i < 64; ++i)
        if (seen[i] != wanted(i)) return 1;
    return 0;
}
#endif
