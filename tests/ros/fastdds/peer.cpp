// A ROS 2 peer on Fast DDS, as rmw_fastrtps_cpp makes one: names `rt/...` and `pkg::msg::dds_::Name_`, no XTypes
// information, history memory that grows. Fast CDR writes and reads the fields, so none of our own code takes part.
//
//   fastdds_peer DOMAIN RANGE pub TOPIC RELIABILITY WIDTH HEIGHT COUNT   an image for each line of standard input
//   fastdds_peer DOMAIN RANGE sub TOPIC RELIABILITY COUNT                a line for each image, ends after COUNT
//
// TOPIC is a ROS topic, or DDSTOPIC=DDSTYPE: an end of a service, whose content nobody reads.
//
// RANGE is localhost or subnet, as in ROS_AUTOMATIC_DISCOVERY_RANGE; RELIABILITY reliable or best_effort. Both say
// "matched" when they are.
//
// Byte i of image n is (i * 31 + i / 251 + n * 7) % 256; its stamp is n s and n + 1 ns, its frame_id "fastdds_<n>".
// `pub` ends when standard input closes; both end with 1 when nothing comes for 20 s.

#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <cstdlib>
#include <iostream>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include <fastcdr/Cdr.h>
#include <fastcdr/FastBuffer.h>
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/DataWriterListener.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/utils/IPLocator.h>

namespace edds = eprosima::fastdds::dds;
namespace rtps = eprosima::fastrtps::rtps;
using eprosima::fastcdr::Cdr;
using eprosima::fastcdr::FastBuffer;

constexpr auto PATIENCE = std::chrono::seconds(20);

struct Image
{
    int32_t sec = 0;
    uint32_t nanosec = 0;
    std::string frame_id;
    uint32_t height = 0;
    uint32_t width = 0;
    std::string encoding;
    uint8_t is_bigendian = 0;
    uint32_t step = 0;
    std::vector<uint8_t> data;
};

uint8_t byte_of(size_t i, uint32_t n)
{
    return static_cast<uint8_t>(i * 31 + i / 251 + n * 7);
}

class ImageType : public edds::TopicDataType
{
public:
    explicit ImageType(const std::string& name)
    {
        setName(name.c_str());
        m_typeSize = 1024;  // only the first guess: the history's memory is reallocated
        auto_fill_type_object(false);
        auto_fill_type_information(false);
    }

    bool serialize(void* data, rtps::SerializedPayload_t* payload) override
    {
        const auto& image = *static_cast<Image*>(data);
        FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->max_size);
        Cdr cdr(buffer, Cdr::DEFAULT_ENDIAN, Cdr::DDS_CDR);
        cdr.serialize_encapsulation();
        cdr << image.sec << image.nanosec << image.frame_id << image.height << image.width << image.encoding
            << image.is_bigendian << image.step << image.data;
        payload->encapsulation = CDR_LE;
        payload->length = static_cast<uint32_t>(cdr.getSerializedDataLength());
        return true;
    }

    bool deserialize(rtps::SerializedPayload_t* payload, void* data) override
    {
        auto& image = *static_cast<Image*>(data);
        FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->length);
        Cdr cdr(buffer, Cdr::DEFAULT_ENDIAN, Cdr::DDS_CDR);
        cdr.read_encapsulation();
        cdr >> image.sec >> image.nanosec >> image.frame_id >> image.height >> image.width >> image.encoding
            >> image.is_bigendian >> image.step >> image.data;
        return true;
    }

    std::function<uint32_t()> getSerializedSizeProvider(void* data) override
    {
        const auto& image = *static_cast<Image*>(data);
        const size_t size = 64 + image.frame_id.size() + image.encoding.size() + image.data.size();
        return [size] { return static_cast<uint32_t>(size); };
    }

    void* createData() override { return new Image; }
    void deleteData(void* data) override { delete static_cast<Image*>(data); }
    bool getKey(void*, rtps::InstanceHandle_t*, bool) override { return false; }
};

/// Counts matched peers and received images, and wakes the main thread.
struct Progress
{
    std::mutex mutex;
    std::condition_variable changed;
    int matched = 0;
    int received = 0;

    void change(int& count, int by)
    {
        const std::lock_guard<std::mutex> lock(mutex);
        count += by;
        changed.notify_all();
    }

    bool wait(int& count, int least)
    {
        std::unique_lock<std::mutex> lock(mutex);
        return changed.wait_for(lock, PATIENCE, [&] { return count >= least; });
    }
};

struct WriterListener : edds::DataWriterListener
{
    explicit WriterListener(Progress& progress) : progress(progress) {}
    void on_publication_matched(edds::DataWriter*, const edds::PublicationMatchedStatus& status) override
    {
        progress.change(progress.matched, status.current_count_change);
    }
    Progress& progress;
};

struct ReaderListener : edds::DataReaderListener
{
    explicit ReaderListener(Progress& progress) : progress(progress) {}
    void on_subscription_matched(edds::DataReader*, const edds::SubscriptionMatchedStatus& status) override
    {
        if (status.current_count_change > 0)
        {
            std::cout << "matched" << std::endl;
        }
    }
    void on_data_available(edds::DataReader* reader) override
    {
        Image image;
        edds::SampleInfo info;
        while (reader->take_next_sample(&image, &info) == ReturnCode_t::RETCODE_OK)
        {
            if (!info.valid_data)
            {
                continue;
            }
            const auto n = static_cast<uint32_t>(image.sec);
            size_t wrong = 0;
            for (size_t i = 0; i < image.data.size(); ++i)
            {
                wrong += image.data[i] != byte_of(i, n);
            }
            std::cout << image.sec << ' ' << image.nanosec << ' ' << image.frame_id << ' ' << image.width << 'x'
                      << image.height << ' ' << image.encoding << " step " << image.step << " bytes "
                      << image.data.size() << " wrong " << wrong << std::endl;
            progress.change(progress.received, 1);
        }
    }
    Progress& progress;
};

/// Join a domain: by Fast DDS's own defaults (subnet), or on loopback only.
edds::DomainParticipant* join(uint32_t domain, bool localhost)
{
    auto* factory = edds::DomainParticipantFactory::get_instance();
    if (!localhost)
    {
        return factory->create_participant(domain, edds::PARTICIPANT_QOS_DEFAULT);
    }
    edds::DomainParticipantQos qos;
    auto& transport = qos.transport();
    auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
    udp->interfaceWhiteList.push_back("127.0.0.1");
    transport.use_builtin_transports = false;
    transport.user_transports.push_back(udp);
    auto& builtin = qos.wire_protocol().builtin;
    builtin.discovery_config.initial_announcements.count = 20;
    rtps::Locator_t peer;
    rtps::IPLocator::setIPv4(peer, "127.0.0.1");
    for (uint32_t index = 0; index < 32; ++index)
    {
        peer.port = 7400 + 250 * domain + 10 + 2 * index;
        builtin.initialPeersList.push_back(peer);
    }
    return factory->create_participant(domain, qos);
}

int publish(edds::DomainParticipant* participant, edds::Topic* topic, bool reliable, char** arguments)
{
    const auto width = static_cast<uint32_t>(std::atoi(arguments[0]));
    const auto height = static_cast<uint32_t>(std::atoi(arguments[1]));
    const auto count = static_cast<uint32_t>(std::atoi(arguments[2]));
    Progress progress;
    WriterListener listener(progress);
    auto qos = edds::DATAWRITER_QOS_DEFAULT;
    qos.reliability().kind = reliable ? edds::RELIABLE_RELIABILITY_QOS : edds::BEST_EFFORT_RELIABILITY_QOS;
    qos.history().kind = edds::KEEP_LAST_HISTORY_QOS;
    qos.history().depth = 10;
    qos.endpoint().history_memory_policy = rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
    qos.publish_mode().kind = edds::ASYNCHRONOUS_PUBLISH_MODE;
    qos.data_sharing().off();
    auto* writer = participant->create_publisher(edds::PUBLISHER_QOS_DEFAULT)->create_datawriter(topic, qos, &listener);
    if (!progress.wait(progress.matched, 1))
    {
        std::cerr << "no subscription matched" << std::endl;
        return 1;
    }
    std::cout << "matched" << std::endl;
    for (uint32_t n = 0; n < count; ++n)
    {
        // a line on standard input asks for the next image
        std::string line;
        if (!std::getline(std::cin, line))
        {
            break;
        }
        Image image;
        image.sec = static_cast<int32_t>(n);
        image.nanosec = n + 1;
        image.frame_id = "fastdds_" + std::to_string(n);
        image.height = height;
        image.width = width;
        image.encoding = "bgr8";
        image.step = 3 * width;
        image.data.resize(static_cast<size_t>(3) * width * height);
        for (size_t i = 0; i < image.data.size(); ++i)
        {
            image.data[i] = byte_of(i, n);
        }
        if (!writer->write(&image))
        {
            std::cerr << "write failed" << std::endl;
            return 1;
        }
    }
    std::string line;
    std::getline(std::cin, line);
    return 0;
}

int subscribe(edds::DomainParticipant* participant, edds::Topic* topic, bool reliable, char** arguments)
{
    Progress progress;
    ReaderListener listener(progress);
    auto qos = edds::DATAREADER_QOS_DEFAULT;
    qos.reliability().kind = reliable ? edds::RELIABLE_RELIABILITY_QOS : edds::BEST_EFFORT_RELIABILITY_QOS;
    qos.history().kind = edds::KEEP_LAST_HISTORY_QOS;
    qos.history().depth = 10;
    qos.endpoint().history_memory_policy = rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
    qos.data_sharing().off();
    participant->create_subscriber(edds::SUBSCRIBER_QOS_DEFAULT)->create_datareader(topic, qos, &listener);
    if (!progress.wait(progress.received, std::atoi(arguments[0])))
    {
        std::cerr << "not every image came" << std::endl;
        return 1;
    }
    return 0;
}

int main(int count, char** arguments)
{
    if (count < 7)
    {
        std::cerr << "usage: fastdds_peer DOMAIN localhost|subnet pub|sub TOPIC reliable|best_effort ..." << std::endl;
        return 2;
    }
    auto* participant = join(static_cast<uint32_t>(std::atoi(arguments[1])), std::string(arguments[2]) == "localhost");
    const std::string told = arguments[4];
    const auto equals = told.find('=');
    const bool is_topic = equals == std::string::npos;
    edds::TypeSupport type(new ImageType(is_topic ? "sensor_msgs::msg::dds_::Image_" : told.substr(equals + 1)));
    type.register_type(participant);
    const bool publishes = std::string(arguments[3]) == "pub";
    const bool reliable = std::string(arguments[5]) == "reliable";
    auto* topic = participant->create_topic(
        is_topic ? "rt" + told : told.substr(0, equals), type.get_type_name(), edds::TOPIC_QOS_DEFAULT);
    const int result = (publishes ? publish : subscribe)(participant, topic, reliable, arguments + 6);
    participant->delete_contained_entities();
    edds::DomainParticipantFactory::get_instance()->delete_participant(participant);
    return result;
}
