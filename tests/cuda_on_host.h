// CUDA on the host, for a sanitizer to watch: a block's threads are fibers, of which one runs until it has to wait.
//
// The sanitizer is told that a barrier orders memory, and that shuffles and ballots do not: so it reports what two
// threads touch without a barrier between them, whatever the order in which the fibers happen to run. That order, and
// that of the blocks, is shuffled by a seed. A barrier or a shuffle that not all threads reach ends the program.
//
// Usage: program FOLDER SEED [BARRIER]. FOLDER/launch is what cuda_on_host.py wrote; FOLDER/memory is written. BARRIER
// is a "file:line" that is left out; those that were met are printed.
#pragma once
#include <algorithm>
#include <cassert>
#include <cfloat>
#include <climits>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <initializer_list>
#include <random>
#include <set>
#include <string>
#include <type_traits>
#include <ucontext.h>
#include <unistd.h>
#include <utility>
#include <vector>
#if defined(__SANITIZE_THREAD__)
#include <sanitizer/tsan_interface.h>
#else
#include <sanitizer/asan_interface.h>
#include <sanitizer/common_interface_defs.h>
#endif

namespace host {

constexpr size_t STACK = 256 * 1024;
constexpr unsigned WARP = 32;

enum Waits { NOTHING, BARRIER, LANES, END };

struct Index { unsigned x = 0, y = 0, z = 0; };

// What fibers and the main thread both touch is atomic, and relaxed: it orders nothing, and is no race.
template <typename T> struct Shared {
    T value {};
    operator T() const { return __atomic_load_n(&value, __ATOMIC_RELAXED); }
    T operator->() const { return *this; }
    void operator=(T next) { __atomic_store_n(&value, next, __ATOMIC_RELAXED); }
};

struct Thread {
    Index index;
    ucontext_t context;
    void* watched = nullptr;  // the sanitizer's idea of the fiber
    const void* stack = nullptr;
    size_t stack_size = STACK;
    Shared<Waits> waits {END};
    Shared<const char*> file;  // of the barrier at which it waits
    Shared<int> line;
    unsigned barriers = 0;
    unsigned exchanges = 0;
};

struct Exchange { unsigned bits[2][WARP]; };  // of a warp; twice, as a lane may be one ahead of another

inline std::vector<Thread>& threads = *new std::vector<Thread>;  // never freed: fibers have touched it
inline std::vector<Exchange> exchanges;
inline Thread main_thread;
inline Shared<Thread*> current {&main_thread};
inline Index block, block_size, grid_size;
inline std::string left_out;
inline std::set<std::string> barriers;
inline void (*run_thread)();
inline char ordered[2];  // what barriers release and acquire, in turns: a thread may have reached the next one already

[[noreturn]] inline void fail(const char* what)
{
    fprintf(stderr, "ERROR: %s, block %u\n", what, block.x);
    fflush(stdout);
    _exit(3);
}

inline void release(unsigned which)
{
#if defined(__SANITIZE_THREAD__)
    __tsan_release(&ordered[which & 1]);
#endif
}

inline void acquire(unsigned which)
{
#if defined(__SANITIZE_THREAD__)
    __tsan_acquire(&ordered[which & 1]);
#endif
}

inline void switch_to(Thread& other)
{
    Thread& before = *static_cast<Thread*>(current);
    current = &other;
#if defined(__SANITIZE_THREAD__)
    __tsan_switch_to_fiber(other.watched, 1);  // 1: this alone orders nothing
    swapcontext(&before.context, &other.context);
#else
    void* kept = nullptr;
    __sanitizer_start_switch_fiber(&kept, other.stack, other.stack_size);
    swapcontext(&before.context, &other.context);
    __sanitizer_finish_switch_fiber(kept, nullptr, nullptr);
#endif
}

inline void wait_for(Waits what)
{
    current->waits = what;
    switch_to(main_thread);
}

inline std::string place_of(const char* file, int line)
{
    const char* name = strrchr(file, '/');
    return std::string(name ? name + 1 : file) + ":" + std::to_string(line);
}

inline void sync(const char* file, int line)
{
    if (place_of(file, line) == left_out)
        return;
    current->file = file;
    current->line = line;
    const unsigned which = current->barriers++;
    release(which);
    wait_for(BARRIER);
    acquire(which);
}

// All lanes of a warp give a value and get all of them.
inline const unsigned* exchange(unsigned mask, unsigned mine)
{
    if (mask != 0xffffffffu)
        fail("a shuffle or ballot of a part of a warp");
    Exchange& warp = exchanges[current->index.x / WARP];
    unsigned* bits = warp.bits[current->exchanges++ & 1];
    __atomic_store_n(&bits[current->index.x % WARP], mine, __ATOMIC_RELAXED);
    wait_for(LANES);
    return bits;
}

inline unsigned lane() { return current->index.x % WARP; }
inline unsigned read(const unsigned* bits, unsigned from) { return __atomic_load_n(&bits[from], __ATOMIC_RELAXED); }

template <typename T> T shuffle(unsigned mask, T value, unsigned from)
{
    static_assert(sizeof(T) == 4);
    unsigned bits;
    memcpy(&bits, &value, 4);
    bits = read(exchange(mask, bits), from < WARP ? from : lane());
    memcpy(&value, &bits, 4);
    return value;
}

inline unsigned ballot(unsigned mask, bool predicate)
{
    const unsigned* bits = exchange(mask, predicate);
    unsigned result = 0;
    for (unsigned i = 0; i < WARP; ++i)
        result |= read(bits, i) << i;
    return result;
}

inline void thread_main()
{
#if !defined(__SANITIZE_THREAD__)
    __sanitizer_finish_switch_fiber(nullptr, &main_thread.stack, &main_thread.stack_size);
#endif
    for (;;) {
        acquire(current->barriers++);
        run_thread();
        release(current->barriers++);
        wait_for(END);
    }
}

// Threads that may go on, in a shuffled order; none when all have ended.
inline std::vector<Thread*> ready(std::mt19937& random)
{
    const auto count = [](Waits what, size_t first, size_t last) {
        return std::count_if(&threads[first], &threads[first] + (last - first),
                             [&](const Thread& thread) { return thread.waits == what; });
    };
    const size_t all = threads.size();
    std::vector<Thread*> result;
    const auto wake = [&](size_t first, size_t last) {
        for (size_t i = first; i < last; ++i)
            result.push_back(&threads[i]);
    };
    for (size_t first = 0; first < all; first += WARP)
        if (count(LANES, first, first + WARP) == WARP)
            wake(first, first + WARP);
    if (result.empty() && size_t(count(BARRIER, 0, all)) == all) {
        for (const Thread& thread : threads)
            barriers.insert(place_of(thread.file, thread.line));
        wake(0, all);
    }
    if (result.empty() && size_t(count(END, 0, all)) != all)
        fail("some threads wait at a barrier or a shuffle that others do not reach");
    std::shuffle(result.begin(), result.end(), random);
    return result;
}

inline void launch(unsigned blocks, unsigned size, unsigned seed)
{
    std::mt19937 random(seed);
    grid_size.x = blocks, block_size.x = size;
    threads = std::vector<Thread>(size);
    exchanges.resize(size / WARP);
#if defined(__SANITIZE_THREAD__)
    main_thread.watched = __tsan_get_current_fiber();
#endif
    for (unsigned i = 0; i < size; ++i) {
        Thread& thread = threads[i];
        thread.index.x = i;
        getcontext(&thread.context);
        thread.stack = thread.context.uc_stack.ss_sp = malloc(STACK);
        thread.context.uc_stack.ss_size = STACK;
        makecontext(&thread.context, thread_main, 0);
#if defined(__SANITIZE_THREAD__)
        thread.watched = __tsan_create_fiber(0);
#endif
    }
    std::vector<unsigned> order(blocks);
    for (unsigned i = 0; i < blocks; ++i)
        order[i] = i;
    std::shuffle(order.begin(), order.end(), random);
    for (unsigned number : order) {
        acquire(0), acquire(1);  // a block's memory is used by the next one
        block.x = number;
        release(0), release(1);
        std::vector<Thread*> next;
        for (Thread& thread : threads)
            next.push_back(&thread);
        std::shuffle(next.begin(), next.end(), random);
        for (; !next.empty(); next = ready(random))
            for (Thread* thread : next)
                switch_to(*thread);
    }
    acquire(0), acquire(1);
}

// A launch as it was recorded: arrays in memory of exactly their size, and arguments that point there.
struct Launch {
    unsigned blocks, size;
    std::vector<char*> memory;
    std::vector<size_t> sizes;
    std::vector<std::vector<char>> arguments;

    explicit Launch(const std::string& folder)
    {
        FILE* file = fopen((folder + "/launch").c_str(), "rb");
        if (!file)
            fail("no launch");
        const auto number = [&] { uint64_t n; if (fread(&n, 8, 1, file) != 1) fail("a short launch"); return n; };
        const auto bytes = [&](char* to, size_t n) { if (fread(to, 1, n, file) != n) fail("a short launch"); };
        blocks = number(), size = number();
        for (size_t left = number(); left; --left) {
            sizes.push_back(number());
            memory.push_back(static_cast<char*>(malloc(sizes.back())));
            bytes(memory.back(), sizes.back());
        }
        for (size_t left = number(); left; --left) {
            std::vector<char> argument(number());
            bytes(argument.data(), argument.size());
            for (size_t pointers = number(); pointers; --pointers) {
                const size_t place = number(), which = number();
                char* const to = memory[which] + number();
                memcpy(&argument[place], &to, sizeof(char*));
            }
            arguments.push_back(argument);
        }
        fclose(file);
    }

    void save(const std::string& folder) const
    {
        FILE* file = fopen((folder + "/memory").c_str(), "wb");
        for (size_t i = 0; i < memory.size(); ++i)
            fwrite(memory[i], 1, sizes[i], file);
        fclose(file);
    }

    template <typename T> T argument(size_t i) const
    {
        if (i >= arguments.size() || arguments[i].size() != sizeof(T))
            fail("an argument of another size");
        T value;
        memcpy(&value, arguments[i].data(), sizeof(T));
        return value;
    }
};

template <typename Bounds, typename... Arguments, size_t... I>
void call(void (*kernel)(Bounds, Arguments...), const Launch& launch, std::index_sequence<I...>)
{
    Bounds bounds {};
    bounds.shape[0] = launch.blocks, bounds.shape[1] = launch.size;
    bounds.size = size_t(launch.blocks) * launch.size, bounds.coord_mult = 1;
    kernel(bounds, launch.argument<Arguments>(I)...);
}

template <typename Bounds, typename... Arguments>
void call(void (*kernel)(Bounds, Arguments...), const Launch& launch)
{
    call(kernel, launch, std::index_sequence_for<Arguments...>());
}

template <typename Kernel> int main(Kernel* kernel, int count, char** words)
{
    static const Launch launch(words[1]);
    static Kernel* const called = kernel;
    left_out = count > 3 ? words[3] : "";
    run_thread = [] { call(called, launch); };
    host::launch(launch.blocks, launch.size, atoi(words[2]));
    launch.save(words[1]);
    for (const std::string& barrier : barriers)
        puts(barrier.c_str());
    return 0;
}

}  // namespace host

#define threadIdx (host::current->index)
#define blockIdx host::block
#define blockDim host::block_size
#define gridDim host::grid_size
#define __syncthreads() host::sync(__FILE__, __LINE__)
#define __shared__ static
#define __is_trivially_destructible(T) std::is_trivially_destructible<T>::value
#define __global__
#define __host__
#define __device__
template <typename T> T __shfl_down_sync(unsigned mask, T value, int by, int = 32) { return host::shuffle(mask, value, host::lane() + by); }
template <typename T> T __shfl_xor_sync(unsigned mask, T value, int by, int = 32) { return host::shuffle(mask, value, host::lane() ^ by); }
template <typename T> T __shfl_sync(unsigned mask, T value, int from, int = 32) { return host::shuffle(mask, value, from % 32); }
inline unsigned __ballot_sync(unsigned mask, bool predicate) { return host::ballot(mask, predicate); }
inline bool __any_sync(unsigned mask, bool predicate) { return host::ballot(mask, predicate) != 0; }
inline int atomicAdd(int* where, int value) { return __atomic_fetch_add(where, value, __ATOMIC_RELAXED); }
inline int __popc(unsigned bits) { return __builtin_popcount(bits); }
inline int __ffs(unsigned bits) { return __builtin_ffs(bits); }
inline int __clz(unsigned bits) { return bits ? __builtin_clz(bits) : 32; }
inline unsigned __brev(unsigned bits)
{
    unsigned turned = 0;
    for (int place = 0; place < 32; ++place)
        turned |= (bits >> place & 1) << (31 - place);
    return turned;
}
inline void __trap() { abort(); }
struct alignas(16) float4 { float x, y, z, w; };
